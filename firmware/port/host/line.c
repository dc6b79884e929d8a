#include "line.h"

#include <errno.h>
#include <fcntl.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <termios.h>
#include <unistd.h>

static bool make_raw(int terminal)
{
    struct termios settings;
    if (tcgetattr(terminal, &settings) != 0) {
        return false;
    }
    settings.c_iflag &= ~(tcflag_t)(IGNBRK | BRKINT | PARMRK | ISTRIP | INLCR | IGNCR | ICRNL | IXON | IXOFF);
    settings.c_oflag &= ~(tcflag_t)OPOST;
    settings.c_lflag &= ~(tcflag_t)(ECHO | ECHONL | ICANON | ISIG | IEXTEN);
    settings.c_cflag = (settings.c_cflag & ~(tcflag_t)(CSIZE | PARENB)) | CS8;
    settings.c_cc[VMIN] = 1;
    settings.c_cc[VTIME] = 0;
    return tcsetattr(terminal, TCSANOW, &settings) == 0;
}

static bool not_waiting(int file)
{
    const int flags = fcntl(file, F_GETFL);
    return flags >= 0 && fcntl(file, F_SETFL, flags | O_NONBLOCK) == 0;
}

static bool open_slave(struct line *line)
{
    if (grantpt(line->master) != 0 || unlockpt(line->master) != 0) {
        return false;
    }
    const char *name = ptsname(line->master);
    if (name == NULL || strlen(name) >= sizeof line->name) {
        return false;
    }
    strcpy(line->name, name);
    line->slave = open(line->name, O_RDWR | O_NOCTTY);
    return line->slave >= 0 && make_raw(line->slave) && not_waiting(line->master);
}

/* A link of that name from before is replaced; a file is not. */
static bool make_link(const char *target, const char *link)
{
    struct stat found;
    if (lstat(link, &found) == 0 && S_ISLNK(found.st_mode)) {
        (void)unlink(link);
    }
    return symlink(target, link) == 0;
}

bool line_open(struct line *line, const char *link)
{
    *line = (struct line){.master = posix_openpt(O_RDWR | O_NOCTTY), .slave = -1};
    if (line->master < 0) {
        return false;
    }
    bool ready = open_slave(line);
    if (ready && link != NULL) {
        ready = make_link(line->name, link);
        line->link = ready ? link : NULL;
    }
    if (!ready) {
        const int why = errno;
        line_close(line);
        errno = why;
    }
    return ready;
}

void line_close(struct line *line)
{
    if (line->link != NULL) {
        (void)unlink(line->link);
        line->link = NULL;
    }
    if (line->slave >= 0) {
        (void)close(line->slave);
    }
    if (line->master >= 0) {
        (void)close(line->master);
    }
    line->slave = line->master = -1;
}

size_t line_read(const struct line *line, uint8_t *bytes, size_t size)
{
    const ssize_t got = read(line->master, bytes, size);
    return got > 0 ? (size_t)got : 0;
}

size_t line_write(const struct line *line, const uint8_t *bytes, size_t size)
{
    const ssize_t put = write(line->master, bytes, size);
    return put > 0 ? (size_t)put : 0;
}
