/* Image: plays the recorded input that its command line names ("replay INPUT OUTPUT") and writes the forces.
 *
 * Prints the system timer's counts for each section (replay.h). Under `-icount shift=10` an instruction takes 1024 ns,
 * which is 25.6 counts of 40 ns: counts / 25.6 are instructions. */
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

/* Of the system timer, which counts down from 2^24. */
static uint32_t elapsed(void)
{
    static uint32_t before;
    const uint32_t now = board_counter();
    const uint32_t passed = (before - now) & 0xFFFFFFU;
    before = board_counter();
    return passed;
}

static void print_cost(const char *name, const struct replay_cost *cost)
{
    print_pair(name, cost->runs, board_print_unsigned);
    print_pair(" ", cost->least, board_print_unsigned);
    print_pair(" ", cost->runs > 0 ? (uint32_t)(cost->total / cost->runs) : 0, board_print_unsigned);
    print_pair(" ", cost->most, board_print_unsigned);
}

static void print_section(void *context, const struct replay_section *section)
{
    (void)context;
    board_print("section ");
    board_print(section->name);
    print_cost("\nticks ", &section->ticks);
    print_cost("\nbytes ", &section->bytes);
    board_print("\n");
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
    board_start_counter();
    const struct replay_hooks hooks = {&output, keep, print_section, elapsed};
    const bool good = replay_run(&replay, input, size, &hooks) && flush(&output);
    board_close(output.handle);
    print_pair("all ", replay.ticks, board_print_unsigned);
    print_pair(" force ", replay.force_crc, board_print_hex);
    print_pair(" sent ", replay.sent_bytes, board_print_unsigned);
    print_pair(" ", replay.sent_crc, board_print_hex);
    print_pair("\nstack ", board_stack_bytes_used(), board_print_unsigned);
    board_print("\n");
    return good ? 0 : 1;
}
