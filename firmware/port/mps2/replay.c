/* Image: plays the recorded input that its command line names ("replay INPUT OUTPUT") and writes the forces. */
#include <string.h>

#include "board.h"
#include "replay.h"

static struct replay replay;
static uint8_t input[1U << 21];
static uint32_t forces[1024];

struct output {
    int32_t handle;
    size_t count;
};

static bool flush(struct output *output)
{
    const size_t size = output->count * sizeof forces[0];
    output->count = 0;
    return size == 0 || board_write(output->handle, forces, size);
}

static bool keep(void *context, uint32_t bits)
{
    struct output *output = context;
    forces[output->count++] = bits;
    return output->count < sizeof forces / sizeof forces[0] || flush(output);
}

/* The next word of the command line, or NULL. */
static const char *word(char **text)
{
    while (**text == ' ') {
        (*text)++;
    }
    const char *here = *text;
    while (**text != '\0' && **text != ' ') {
        (*text)++;
    }
    if (**text == ' ') {
        *(*text)++ = '\0';
    }
    return *here != '\0' ? here : NULL;
}

static void print_pair(const char *name, uint32_t value, void (*print)(uint32_t))
{
    board_print(name);
    print(value);
}

int main(void)
{
    static char line[1024];
    char *rest = line;
    if (!board_command_line(line, sizeof line) || word(&rest) == NULL) {
        return 2;
    }
    const char *from = word(&rest);
    const char *into = word(&rest);
    const int32_t source = from != NULL ? board_open(from, false) : -1;
    struct output output = {.handle = into != NULL ? board_open(into, true) : -1};
    if (source < 0 || output.handle < 0) {
        board_print("usage: replay INPUT OUTPUT\n");
        return 2;
    }
    const size_t size = board_read(source, input, sizeof input);
    const bool good = replay_run(&replay, input, size, keep, &output) && flush(&output);
    board_close(output.handle);
    print_pair("ticks ", replay.ticks, board_print_unsigned);
    print_pair(" force ", replay.force_crc, board_print_hex);
    print_pair(" sent ", replay.sent_bytes, board_print_unsigned);
    print_pair(" ", replay.sent_crc, board_print_hex);
    print_pair("\nstack ", board_stack_bytes_used(), board_print_unsigned);
    board_print("\n");
    return good ? 0 : 1;
}
