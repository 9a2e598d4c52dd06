/* Wait for many descriptors together, with epoll. */
#define _GNU_SOURCE
#include "internal.h"

#include <poll.h>
#include <stdlib.h>
#include <sys/epoll.h>
#include <sys/syscall.h>
#include <unistd.h>

#ifndef SYS_epoll_pwait2
#define SYS_epoll_pwait2 (-1) /* headers before Linux 5.11 lack it; system call -1 always fails */
#endif

enum { EVENTS = 256 }; /* limit of the events fetched by a system call */

typedef int wait_function(int epoll, struct epoll_event *events, int most, int64_t timeout_ns);

struct md_waiter {
    int epoll;
    wait_function *wait;
};

/* Call epoll_pwait2() by its number, because musl and glibc before 2.35 have no function for it. The two
 * fields of its timeout are 64 bits wide on all systems. */
static int wait_at_once(int epoll, struct epoll_event *events, int most, int64_t timeout_ns)
{
    const int64_t span[] = {timeout_ns / MD_SECOND_NS, timeout_ns % MD_SECOND_NS};
    return (int)syscall(SYS_epoll_pwait2, epoll, events, most, timeout_ns < 0 ? NULL : span, NULL, (size_t)0);
}

/* Wait without epoll_pwait2(), which Linux before 5.11 lacks and some containers forbid. */
static int poll_first(int epoll, struct epoll_event *events, int most, int64_t timeout_ns)
{
    struct pollfd any = {.fd = epoll, .events = POLLIN};
    struct timespec span = timespec_of(timeout_ns);
    int n = ppoll(&any, 1, timeout_ns < 0 ? NULL : &span, NULL);
    return n > 0 ? epoll_wait(epoll, events, most, 0) : n;
}

static wait_function *best_wait(int epoll)
{
    struct epoll_event event;
    return wait_at_once(epoll, &event, 1, 0) < 0 ? poll_first : wait_at_once;
}

struct md_waiter *md_waiter_new(void)
{
    struct md_waiter *waiter = malloc(sizeof *waiter);
    if (!waiter)
        return NULL;
    waiter->epoll = epoll_create1(EPOLL_CLOEXEC);
    if (waiter->epoll < 0) {
        free(waiter);
        return NULL;
    }
    waiter->wait = best_wait(waiter->epoll);
    return waiter;
}

void md_waiter_free(struct md_waiter *waiter)
{
    close(waiter->epoll);
    free(waiter);
}

int md_waiter_add(struct md_waiter *waiter, int fd, void *owner)
{
    struct epoll_event event = {.events = EPOLLIN, .data.ptr = owner};
    return epoll_ctl(waiter->epoll, EPOLL_CTL_ADD, fd, &event);
}

void md_waiter_change(struct md_waiter *waiter, int fd, void *owner, int watched)
{
    struct epoll_event event = {.events = watched ? EPOLLIN : 0, .data.ptr = owner};
    epoll_ctl(waiter->epoll, EPOLL_CTL_MOD, fd, &event);
}

void md_waiter_remove(struct md_waiter *waiter, int fd)
{
    epoll_ctl(waiter->epoll, EPOLL_CTL_DEL, fd, NULL);
}

int md_waiter_wait(struct md_waiter *waiter, void **ready, int room, int64_t timeout_ns)
{
    struct epoll_event events[EVENTS];
    int n = waiter->wait(waiter->epoll, events, room < EVENTS ? room : EVENTS, timeout_ns);
    for (int i = 0; i < n; i++)
        ready[i] = events[i].data.ptr;
    return n;
}
