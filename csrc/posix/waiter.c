/* Wait for many descriptors together: with epoll on Linux, with poll() on other POSIX systems. A pipe wakes
 * the waiting thread. */
#define _GNU_SOURCE
#include "internal.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdlib.h>
#include <unistd.h>

#if defined __linux__ && !defined MD_WAITS_BY_POLL
#include <sys/epoll.h>
#include <sys/syscall.h>

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
    struct md_waiter *waiter = calloc(1, sizeof *waiter);
    if (waiter && (waiter->epoll = epoll_create1(EPOLL_CLOEXEC)) >= 0) {
        waiter->wait = best_wait(waiter->epoll);
        return waiter;
    }
    free(waiter);
    return NULL;
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

#else

struct md_waiter {
    struct pollfd *fds; /* an unwatched descriptor is stored as ~fd, which poll() ignores */
    void **owners;
    int count, room;
};

static int grow(struct md_waiter *waiter)
{
    if (waiter->count < waiter->room)
        return 1;
    int room = waiter->room ? 2 * waiter->room : 16;
    struct pollfd *fds = realloc(waiter->fds, (size_t)room * sizeof *fds);
    if (fds)
        waiter->fds = fds;
    void **owners = realloc(waiter->owners, (size_t)room * sizeof *owners);
    if (owners)
        waiter->owners = owners;
    if (!fds || !owners)
        return 0;
    waiter->room = room;
    return 1;
}

static int find(const struct md_waiter *waiter, int fd)
{
    int at = waiter->count;
    while (at-- > 0 && waiter->fds[at].fd != fd && waiter->fds[at].fd != ~fd)
        ;
    return at;
}

struct md_waiter *md_waiter_new(void)
{
    return calloc(1, sizeof(struct md_waiter));
}

void md_waiter_free(struct md_waiter *waiter)
{
    free(waiter->fds);
    free(waiter->owners);
    free(waiter);
}

int md_waiter_add(struct md_waiter *waiter, int fd, void *owner)
{
    struct pollfd entry = {.fd = fd, .events = POLLIN};
    if (fd < 0 || poll(&entry, 1, 0) < 0 || entry.revents & POLLNVAL)
        errno = EBADF;
    else if (!grow(waiter))
        errno = ENOMEM;
    else {
        waiter->fds[waiter->count] = entry;
        waiter->owners[waiter->count++] = owner;
        return 0;
    }
    return -1;
}

void md_waiter_change(struct md_waiter *waiter, int fd, void *owner, int watched)
{
    int at = find(waiter, fd);
    if (at < 0)
        return;
    waiter->fds[at].fd = watched ? fd : ~fd;
    waiter->owners[at] = owner;
}

void md_waiter_remove(struct md_waiter *waiter, int fd)
{
    int at = find(waiter, fd);
    if (at < 0)
        return;
    waiter->fds[at] = waiter->fds[--waiter->count];
    waiter->owners[at] = waiter->owners[waiter->count];
}

/* Without ppoll() the wait lasts whole milliseconds, and the caller waits for the rest. */
static int wait_for_any(struct md_waiter *waiter, int64_t timeout_ns)
{
#ifdef __linux__
    struct timespec span = timespec_of(timeout_ns);
    return ppoll(waiter->fds, (nfds_t)waiter->count, timeout_ns < 0 ? NULL : &span, NULL);
#else
    int64_t ms = timeout_ns < 0 ? -1 : timeout_ns / 1000000;
    return poll(waiter->fds, (nfds_t)waiter->count, ms > 1000 ? 1000 : (int)ms);
#endif
}

int md_waiter_wait(struct md_waiter *waiter, void **ready, int room, int64_t timeout_ns)
{
    int left = wait_for_any(waiter, timeout_ns), n = 0;
    for (int at = 0; at < waiter->count && n < left && n < room; at++)
        if (waiter->fds[at].fd >= 0 && waiter->fds[at].revents)
            ready[n++] = waiter->owners[at];
    return left < 0 ? left : n;
}

#endif

/* ---- the wake-up: a pipe with which any thread wakes the waiting thread ---- */

static int set_up(int fd)
{
    return fcntl(fd, F_SETFD, FD_CLOEXEC) == 0 && fcntl(fd, F_SETFL, O_NONBLOCK) == 0;
}

int md_wakeup_make(struct md_wakeup *wakeup)
{
    int ends[2];
    if (pipe(ends))
        return -1;
    *wakeup = (struct md_wakeup){.fd = ends[0], .ringer = ends[1]};
    if (set_up(ends[0]) && set_up(ends[1]))
        return 0;
    md_wakeup_destroy(wakeup);
    return -1;
}

void md_wakeup_destroy(struct md_wakeup *wakeup)
{
    close(wakeup->fd);
    close(wakeup->ringer);
}

void md_wakeup_ring(struct md_wakeup *wakeup)
{
    if (!atomic_exchange(&wakeup->is_rung, 1))
        (void)!write(wakeup->ringer, "", 1);
}

/* If another thread calls md_wakeup_ring() meanwhile, its byte stays in the pipe: no wake-up is lost. */
void md_wakeup_silence(struct md_wakeup *wakeup)
{
    char byte;
    atomic_store(&wakeup->is_rung, 0);
    (void)!read(wakeup->fd, &byte, 1);
}
