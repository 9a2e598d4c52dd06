/* Waiting for many descriptors at once, as Linux does it. */
#define _GNU_SOURCE
#include "internal.h"

#include <poll.h>
#include <stdlib.h>
#include <sys/epoll.h>
#include <time.h>
#include <unistd.h>

enum { EVENTS = 256 }; /* taken at a time */

typedef int wait_function(int epoll, struct epoll_event *events, int most, const struct timespec *span,
                          const sigset_t *signals);

struct md_waiter {
    int epoll;
    wait_function *wait;
};

/* epoll_pwait2() where the system has none: before Linux 5.11, and where a container forbids it. */
static int poll_first(int epoll, struct epoll_event *events, int most, const struct timespec *span,
                      const sigset_t *signals)
{
    struct pollfd any = {.fd = epoll, .events = POLLIN};
    int n = ppoll(&any, 1, span, signals);
    return n > 0 ? epoll_wait(epoll, events, most, 0) : n;
}

static wait_function *best_wait(int epoll)
{
    struct epoll_event event;
    struct timespec at_once = {0};
    return epoll_pwait2(epoll, &event, 1, &at_once, NULL) < 0 ? poll_first : epoll_pwait2;
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

int md_waiter_add(struct md_waiter *waiter, int fd, void *whose)
{
    struct epoll_event event = {.events = EPOLLIN, .data.ptr = whose};
    return epoll_ctl(waiter->epoll, EPOLL_CTL_ADD, fd, &event);
}

void md_waiter_change(struct md_waiter *waiter, int fd, void *whose, int watched)
{
    struct epoll_event event = {.events = watched ? EPOLLIN : 0, .data.ptr = whose};
    epoll_ctl(waiter->epoll, EPOLL_CTL_MOD, fd, &event);
}

void md_waiter_remove(struct md_waiter *waiter, int fd)
{
    epoll_ctl(waiter->epoll, EPOLL_CTL_DEL, fd, NULL);
}

int md_waiter_wait(struct md_waiter *waiter, void **ready, int room, int64_t timeout_ns)
{
    struct epoll_event events[EVENTS];
    struct timespec span = {.tv_sec = timeout_ns / 1000000000, .tv_nsec = timeout_ns % 1000000000};
    int most = room < EVENTS ? room : EVENTS;
    int n = waiter->wait(waiter->epoll, events, most, timeout_ns < 0 ? NULL : &span, NULL);
    for (int i = 0; i < n; i++)
        ready[i] = events[i].data.ptr;
    return n;
}
