/* hilbo-replay INPUT OUTPUT: the forces that a recorded input gives (see replay.h), 4 bytes each as the machine has them. */
#include <stdio.h>
#include <stdlib.h>

#include "replay.h"

static bool keep(void *context, uint32_t bits)
{
    return fwrite(&bits, sizeof bits, 1, (FILE *)context) == 1;
}

static size_t read_all(const char *path, uint8_t *bytes, size_t room)
{
    FILE *file = fopen(path, "rb");
    if (file == NULL) {
        return 0;
    }
    const size_t size = fread(bytes, 1, room, file);
    (void)fclose(file);
    return size;
}

int main(int count, char **arguments)
{
    static struct replay replay;
    static uint8_t input[1U << 21];
    FILE *output = count == 3 ? fopen(arguments[2], "wb") : NULL;
    if (output == NULL) {
        (void)fputs("usage: hilbo-replay INPUT OUTPUT\n", stderr);
        return 2;
    }
    const size_t size = read_all(arguments[1], input, sizeof input);
    const struct replay_hooks hooks = {.context = output, .force = keep};
    const bool good = replay_run(&replay, input, size, &hooks);
    const bool kept = fclose(output) == 0;
    (void)printf("all %lu force %08lx sent %lu %08lx\n", (unsigned long)replay.ticks, (unsigned long)replay.force_crc,
                 (unsigned long)replay.sent_bytes, (unsigned long)replay.sent_crc);
    return good && kept ? EXIT_SUCCESS : EXIT_FAILURE;
}
