/* The core passes the duration of a wait to the system without rounding. This test intercepts the system
 * calls. */
#define _GNU_SOURCE
#include "internal.h"

#include <assert.h>
#include <errno.h>
#include <poll.h>
#include <stdarg.h>
#include <stddef.h>
#include <sys/epoll.h>
#include <sys/syscall.h>
#include <unistd.h>

static int has_pwait2;
static int64_t asked_ns;

/* epoll_pwait2(fd, events, most, span, signals, size): the only system call that is made by number */
long syscall(long number, ...)
{
    va_list arguments;
    assert(number == SYS_epoll_pwait2);
    va_start(arguments, number);
    (void)va_arg(arguments, int), (void)va_arg(arguments, void *), (void)va_arg(arguments, int);
    const int64_t *span = va_arg(arguments, const int64_t *);
    va_end(arguments);
    errno = ENOSYS;
    if (has_pwait2)
        asked_ns = span ? span[0] * INT64_C(1000000000) + span[1] : -1;
    return has_pwait2 ? 0 : -1;
}

int ppoll(struct pollfd *fds, nfds_t count, const struct timespec *span, const sigset_t *signals)
{
    (void)fds, (void)count, (void)signals;
    assert(!has_pwait2); /* poll() is not called if epoll_pwait2() exists */
    asked_ns = span ? span->tv_sec * INT64_C(1000000000) + span->tv_nsec : -1;
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
