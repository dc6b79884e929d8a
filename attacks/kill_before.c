/* Preloaded into a process: kills it before its n-th change of the disk, as a cut of the power would. A write that is the
 * n-th change writes half of its bytes first. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

static atomic_long changes; /* that are still to come before the kill; no kill where it was never set */

void hilbo_kill_before(long n) { atomic_store(&changes, n); }

static int is_last(void) { return atomic_load(&changes) > 0 && atomic_fetch_sub(&changes, 1) == 1; }

static void die(void)
{
    kill(getpid(), SIGKILL);
    for (;;) {
        pause();
    }
}

static void change(void)
{
    if (is_last()) {
        die();
    }
}

static int is_file(int fd)
{
    struct stat seen;
    return fstat(fd, &seen) == 0 && S_ISREG(seen.st_mode);
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define CHANGE(name, parameters, arguments)      \
    int name parameters                          \
    {                                            \
        change();                                \
        return REAL(name) arguments;             \
    }

CHANGE(rename, (const char *a, const char *b), (a, b))
CHANGE(renameat, (int f, const char *a, int g, const char *b), (f, a, g, b))
CHANGE(renameat2, (int f, const char *a, int g, const char *b, unsigned int flags), (f, a, g, b, flags))
CHANGE(link, (const char *a, const char *b), (a, b))
CHANGE(linkat, (int f, const char *a, int g, const char *b, int flags), (f, a, g, b, flags))
CHANGE(symlink, (const char *a, const char *b), (a, b))
CHANGE(unlink, (const char *a), (a))
CHANGE(unlinkat, (int f, const char *a, int flags), (f, a, flags))
CHANGE(mkdir, (const char *a, mode_t mode), (a, mode))
CHANGE(mkdirat, (int f, const char *a, mode_t mode), (f, a, mode))
CHANGE(rmdir, (const char *a), (a))
CHANGE(chmod, (const char *a, mode_t mode), (a, mode))
CHANGE(fchmod, (int f, mode_t mode), (f, mode))
CHANGE(ftruncate, (int f, off_t size), (f, size))
CHANGE(ftruncate64, (int f, off64_t size), (f, size))

#define OPEN(name, head, first)                                    \
    int name head                                                  \
    {                                                              \
        va_list more;                                              \
        va_start(more, flags);                                     \
        const mode_t mode = flags & O_CREAT ? va_arg(more, mode_t) : 0; \
        va_end(more);                                              \
        if (flags & (O_CREAT | O_TRUNC)) {                         \
            change();                                              \
        }                                                          \
        return REAL(name) first;                                   \
    }

OPEN(open, (const char *a, int flags, ...), (a, flags, mode))
OPEN(open64, (const char *a, int flags, ...), (a, flags, mode))
OPEN(openat, (int f, const char *a, int flags, ...), (f, a, flags, mode))
OPEN(openat64, (int f, const char *a, int flags, ...), (f, a, flags, mode))

FILE *fopen64(const char *path, const char *mode)
{
    if (mode[0] != 'r') {
        change();
    }
    return REAL(fopen64)(path, mode);
}

ssize_t write(int fd, const void *bytes, size_t count)
{
    if (is_file(fd) && is_last()) {
        REAL(write)(fd, bytes, count / 2);
        die();
    }
    return REAL(write)(fd, bytes, count);
}

ssize_t pwrite64(int fd, const void *bytes, size_t count, off64_t at)
{
    if (is_file(fd) && is_last()) {
        REAL(pwrite64)(fd, bytes, count / 2, at);
        die();
    }
    return REAL(pwrite64)(fd, bytes, count, at);
}

ssize_t pwrite(int fd, const void *bytes, size_t count, off_t at)
{
    if (is_file(fd) && is_last()) {
        REAL(pwrite)(fd, bytes, count / 2, at);
        die();
    }
    return REAL(pwrite)(fd, bytes, count, at);
}
