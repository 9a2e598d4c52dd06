/* What the engine's thread and its clients know of each other, and of each port: engine.c and
 * engine_port.c alone. */
#ifndef MULTIDROP_ENGINE_H
#define MULTIDROP_ENGINE_H

#include "internal.h"

#include <pthread.h>
#include <stdatomic.h>

#define MD_NEVER INT64_MAX

enum { MD_MOST_LATENESS = 80000 }; /* ns of a wake-up that are reckoned with */

/* An exchange that is queued. */
struct slot {
    const struct md_exchange *exchange;
    int64_t not_before_ns;
};

/* An urgent exchange; it lives where its caller waits. */
struct wish {
    const struct md_exchange *exchange;
    int64_t not_before_ns, expires_ns;
    struct md_completion *completion;
    struct wish *next;
    int done;
};

/* Whose exchange is under way. */
enum turn { NOBODYS, BEFORE, WISHED, QUEUED, REPEATED }; /* BEFORE: what is asked before somebody's */

struct md_port {
    struct md_engine *engine;
    unsigned index; /* among the engine's ports */
    int fd, must_take;
    struct md_settings settings; /* in force; baudrate 0: not yet set */

    struct slot *slots;
    unsigned room; /* a power of two */
    struct md_progress progress; /* its counters have one writer each, and are read atomically */
    atomic_int idle;    /* the thread waits to be told of more */
    struct wish *wishes;
    const struct md_exchange *const *round; /* what is repeated */
    unsigned round_len, round_at;
    struct md_row_queue *row_queue;
    uint32_t number; /* there */

    enum turn turn, last_turn; /* of now, and of the exchange that was carried out last */
    int64_t owed_ns;           /* of the line, to what is polled beside urgent exchanges */
    struct md_before before;
    int blind;         /* nothing is worth reading before the port's waking time */
    int watched;       /* the waiter tells when it can be read */
    int emptied;       /* it was read empty a moment ago: nothing is there yet */
    int lost_error;
    struct md_port *next; /* of those that wait to be opened */
    int opened, open_error;
    int ending, closing, closed;
    struct md_line line;
    struct md_completion completion;
};

struct md_engine {
    pthread_t thread;
    pthread_mutex_t mutex;  /* held by the thread but while it waits; guards all below, and the wishes */
    atomic_int callers;     /* clients that want the mutex, whom the thread lets in */
    pthread_cond_t changed; /* a wish was granted, a port opened or closed */
    struct md_waiter *waiter;
    struct md_wakeup wakeup;
    struct md_port *arriving; /* clients wait for these to be opened */
    struct md_port **ports;
    int64_t *wakes; /* when the thread is to wake for each port, whatever happens */
    unsigned count, room;
    int64_t lateness_ns; /* of the thread's waking, as is usual */
};

static inline uint32_t md_get(const uint32_t *counter)
{
    return __atomic_load_n(counter, __ATOMIC_SEQ_CST);
}

static inline void md_put(uint32_t *counter, uint32_t value)
{
    __atomic_store_n(counter, value, __ATOMIC_SEQ_CST);
}

/* ---- engine_port.c: on the engine's thread ---- */

int64_t md_port_hear(struct md_port *port); /* what has come; when it was read */
/* Carry on until there is nothing to do but to wait; what time it was then. */
int64_t md_port_advance(struct md_port *port, int64_t now_ns);
void md_port_finish(struct md_port *port); /* the exchange under way is over */

#endif
