/* A pseudo-terminal as the serial line: the device has the master, the host opens the slave by its name. */
#ifndef HOST_LINE_H
#define HOST_LINE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

struct line {
    int master;
    int slave; /* kept open, so that the line stays raw and the master lives on while no host is there */
    char name[128];
    const char *link; /* a symbolic link to the slave, or NULL */
};

/* False, with errno set, where the system gives no pseudo-terminal or the link cannot be made. */
bool line_open(struct line *line, const char *link);
void line_close(struct line *line);

/* Bytes read or written; 0 where there are none, or no room, or nobody to talk to. Never wait. */
size_t line_read(const struct line *line, uint8_t *bytes, size_t size);
size_t line_write(const struct line *line, const uint8_t *bytes, size_t size);

#endif
