/* Wait for many handles together: an alertable wait for a timer and for the wake-up event, during which
 * completion routines run. */
#include "file.h"

#include <errno.h>
#include <stdlib.h>

#ifndef CREATE_WAITABLE_TIMER_HIGH_RESOLUTION
#define CREATE_WAITABLE_TIMER_HIGH_RESOLUTION 2
#endif

enum { WAKEUP, TIMER, OBJECTS };

struct md_waiter {
    HANDLE objects[OBJECTS];
    int has_files; /* 1: the files of file.c belong to this waiter's thread */
};

/* Windows before 10 1803 has only normal timers, which are up to 16 ms late. */
static HANDLE new_timer(void)
{
    HANDLE timer =
        CreateWaitableTimerExW(NULL, NULL, CREATE_WAITABLE_TIMER_HIGH_RESOLUTION, TIMER_ALL_ACCESS);
    return timer ? timer : CreateWaitableTimerW(NULL, FALSE, NULL);
}

struct md_waiter *md_waiter_new(void)
{
    struct md_waiter *waiter = calloc(1, sizeof *waiter);
    if (waiter && (waiter->objects[TIMER] = new_timer()) != NULL)
        return waiter;
    free(waiter);
    return NULL;
}

void md_waiter_free(struct md_waiter *waiter)
{
    CloseHandle(waiter->objects[TIMER]);
    free(waiter);
}

/* `owner` NULL: `fd` is the wake-up event. */
int md_waiter_add(struct md_waiter *waiter, int fd, void *owner)
{
    if (owner) {
        waiter->has_files = 1;
        return md_file_add(fd, owner);
    }
    waiter->objects[WAKEUP] = handle_of(fd);
    return 0;
}

void md_waiter_change(struct md_waiter *waiter, int fd, void *owner, int watched)
{
    (void)waiter, (void)owner;
    md_file_watch(fd, watched);
}

void md_waiter_remove(struct md_waiter *waiter, int fd)
{
    (void)waiter;
    md_file_remove(fd);
}

int md_waiter_wait(struct md_waiter *waiter, void **ready, int room, int64_t timeout_ns)
{
    LARGE_INTEGER span = {.QuadPart = -(timeout_ns + 99) / 100}; /* negative: from now on */
    int most_files = waiter->has_files ? room - 1 : 0, n = md_files_ready(ready, most_files);
    DWORD count = timeout_ns < 0 ? TIMER : OBJECTS, most = timeout_ns && !n ? INFINITE : 0, ended;
    if (timeout_ns > 0 && !n)
        SetWaitableTimer(waiter->objects[TIMER], &span, 0, NULL, NULL, FALSE);
    do {
        ended = WaitForMultipleObjectsEx(count, waiter->objects, FALSE, most, TRUE);
        n += md_files_ready(ready + n, most_files - n);
    } while (ended == WAIT_IO_COMPLETION && !n && most); /* wait again if only a write has completed */
    if (ended == WAIT_OBJECT_0 + WAKEUP)
        ready[n++] = NULL;
    return n;
}

/* ---- the wake-up: an event with which any thread wakes the waiting thread ---- */

int md_wakeup_make(struct md_wakeup *wakeup)
{
    HANDLE event = CreateEventW(NULL, FALSE, FALSE, NULL); /* the event resets itself when it ends a wait */
    *wakeup = (struct md_wakeup){.fd = (int)(intptr_t)event};
    errno = event ? 0 : ENOMEM;
    return event ? 0 : -1;
}

void md_wakeup_destroy(struct md_wakeup *wakeup)
{
    CloseHandle(handle_of(wakeup->fd));
}

void md_wakeup_ring(struct md_wakeup *wakeup)
{
    if (!atomic_exchange(&wakeup->is_rung, 1))
        SetEvent(handle_of(wakeup->fd));
}

/* The thread is about to handle an earlier wake-up; a later wake-up ends its next wait. */
void md_wakeup_silence(struct md_wakeup *wakeup)
{
    atomic_store(&wakeup->is_rung, 0);
}
