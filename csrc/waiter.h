/* Waiting for many descriptors at once: waiter_epoll.c where the system is Linux, else waiter_poll.c. */
#ifndef MULTIDROP_WAITER_H
#define MULTIDROP_WAITER_H

#include <stdatomic.h>
#include <stdint.h>

struct md_waiter;

struct md_waiter *md_waiter_new(void); /* NULL: see errno */
void md_waiter_free(struct md_waiter *waiter);
/* From now on `whose` is told of when the descriptor can be read; -1: see errno. */
int md_waiter_add(struct md_waiter *waiter, int fd, void *whose);
/* Look away from a descriptor for a while, or look at it again. */
void md_waiter_change(struct md_waiter *waiter, int fd, void *whose, int watched);
void md_waiter_remove(struct md_waiter *waiter, int fd);
/* Who can read; how many. Waits for so long, or for ever where it is negative. */
int md_waiter_wait(struct md_waiter *waiter, void **ready, int room, int64_t timeout_ns);

/* ---- wakeup.c ---- */

struct md_wakeup {
    int fd, ringer; /* `fd` can be read while it rings */
    atomic_int is_rung;
};

int md_wakeup_make(struct md_wakeup *wakeup); /* -1: see errno */
void md_wakeup_destroy(struct md_wakeup *wakeup);
void md_wakeup_ring(struct md_wakeup *wakeup);
void md_wakeup_silence(struct md_wakeup *wakeup);

#endif
