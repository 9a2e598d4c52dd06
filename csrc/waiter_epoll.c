/* Waiting for many descriptors at once, as Linux does it. */
#define _GNU_SOURCE
#include "waiter.h"

#include <errno.h>
#include <stdlib.h>
#include <sys/epoll.h>
#include <time.h>
#include <unistd.h>

enum { EVENTS = 256 }; /* taken at a time */

struct md_waiter {
    int epoll;
};

struct md_waiter *md_waiter_new(void)
{
    struct md_waiter *waiter = malloc(sizeof *waiter);
    if (!waiter)
        return NULL;
    waiter->epoll = epoll_create1(EPOLL_CLOEXEC);
    if (waiter->epoll >= 0)
        return waiter;
    free(waiter);
    return NULL;
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
    int n = epoll_pwait2(waiter->epoll, events, most, timeout_ns < 0 ? NULL : &span, NULL);
    for (int i = 0; i < n; i++)
        ready[i] = events[i].data.ptr;
    return n;
}
