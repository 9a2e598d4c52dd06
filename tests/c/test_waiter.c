/* How long the system is asked to wait, to the nanosecond: what it is asked comes here. */
#define _GNU_SOURCE
#include "internal.h"

#include <assert.h>
#include <errno.h>
#include <poll.h>
#include <stddef.h>
#include <sys/epoll.h>
#include <time.h>

static int has_pwait2;
static int64_t asked_ns;

static void note(const struct timespec *span)
{
    asked_ns = span ? span->tv_sec * INT64_C(1000000000) + span->tv_nsec : -1;
}

int epoll_pwait2(int fd, struct epoll_event *events, int most, const struct timespec *span,
                 const sigset_t *signals)
{
    (void)fd, (void)events, (void)most, (void)signals;
    errno = ENOSYS;
    if (has_pwait2)
        note(span);
    return has_pwait2 ? 0 : -1;
}

int ppoll(struct pollfd *fds, nfds_t count, const struct timespec *span, const sigset_t *signals)
{
    (void)fds, (void)count, (void)signals;
    assert(!has_pwait2); /* else it would be a call more */
    note(span);
    return 0;
}

int main(void)
{
    static const int64_t spans_ns[] = {-1, 0, 1, 999, 1000, 499999, 1000001, 999999999, 1000000000,
                                       INT64_C(90000000001)};
    void *ready[1];
    for (has_pwait2 = 0; has_pwait2 < 2; has_pwait2++) {
        struct md_waiter *waiter = md_waiter_new();
        assert(waiter);
        for (size_t i = 0; i < sizeof spans_ns / sizeof *spans_ns; i++) {
            assert(md_waiter_wait(waiter, ready, 1, spans_ns[i]) == 0);
            assert(asked_ns == spans_ns[i]);
        }
        md_waiter_free(waiter);
    }
    return 0;
}
