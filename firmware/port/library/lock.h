/* One lock: of pthreads, with priority inheritance where the system has it, or of Windows. */
#ifndef LIBRARY_LOCK_H
#define LIBRARY_LOCK_H

#include <stdbool.h>

#if defined(_WIN32)
#include <windows.h>

struct lock {
    SRWLOCK of_system;
};

static inline bool lock_make(struct lock *lock)
{
    InitializeSRWLock(&lock->of_system);
    return true;
}

static inline void lock_end(struct lock *lock)
{
    (void)lock;
}

static inline void lock_take(struct lock *lock)
{
    AcquireSRWLockExclusive(&lock->of_system);
}

static inline void lock_leave(struct lock *lock)
{
    ReleaseSRWLockExclusive(&lock->of_system);
}

#else
#include <pthread.h>
#include <unistd.h>

struct lock {
    pthread_mutex_t of_system;
};

/* A thread of low priority that holds the lock gets that of the loop which waits for it. */
static inline bool lock_make(struct lock *lock)
{
    pthread_mutexattr_t kind;
    if (pthread_mutexattr_init(&kind) != 0) {
        return false;
    }
#if defined(_POSIX_THREAD_PRIO_INHERIT) && _POSIX_THREAD_PRIO_INHERIT > 0
    (void)pthread_mutexattr_setprotocol(&kind, PTHREAD_PRIO_INHERIT);
#endif
    const bool made = pthread_mutex_init(&lock->of_system, &kind) == 0;
    (void)pthread_mutexattr_destroy(&kind);
    return made;
}

static inline void lock_end(struct lock *lock)
{
    (void)pthread_mutex_destroy(&lock->of_system);
}

static inline void lock_take(struct lock *lock)
{
    (void)pthread_mutex_lock(&lock->of_system);
}

static inline void lock_leave(struct lock *lock)
{
    (void)pthread_mutex_unlock(&lock->of_system);
}
#endif

#endif
