/* Wait for many descriptors together, with poll(), which every POSIX system has. */
#ifdef __linux__
#define _GNU_SOURCE
#endif
#include "internal.h"

#include <errno.h>
#include <poll.h>
#include <stdlib.h>

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
