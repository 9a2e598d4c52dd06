/* Whose turn it is on a line. Tests see the marked part, too. */
#ifndef MULTIDROP_TURN_H
#define MULTIDROP_TURN_H

#include "line.h"

/* cdef: begin */
/* ---- port_turn.c: whose turn it is on a line; I/O and time come from outside ---- */

/* Proofs and echo probes are sent beforehand. */
enum md_whose { MD_NOBODYS, MD_BEFOREHAND, MD_URGENT, MD_QUEUED, MD_REPEATED };

struct md_slot {
    const struct md_exchange *exchange;
    int64_t not_before_ns;
};

/* An urgent request; it lives where its caller waits. */
struct md_urgent {
    const struct md_exchange *exchange;
    int64_t not_before_ns; /* 0: at once */
    int64_t expires_ns;    /* of CLOCK_BOOTTIME; 0: never */
    struct md_completion *completion;
    struct md_urgent *next;
    int is_done;
};

/* The requests sent before an exchange. Zeroed, none was. */
struct md_before {
    const struct md_exchange *then; /* the exchange */
    uint64_t replies;               /* of its drive, before the last proof */
    uint32_t proofs, is_probed;     /* proofs sent; its echo probe was sent */
    uint32_t failures;              /* of its drive, before all of that */
};

struct md_turn {
    int whose, last;      /* enum md_whose: of the exchange under way, and of the one before it */
    int is_ending;        /* nothing more that is polled is begun */
    int has_done_urgent;  /* since its caller looked */
    struct md_urgent *urgent;
    const struct md_exchange *const *round; /* what is repeated */
    uint32_t round_len, round_at;
    struct md_slot *slots; /* a ring */
    uint32_t room;         /* a power of two */
    uint32_t is_idle;      /* the thread waits to be woken when more is queued */
    int64_t owed_ns;       /* of the line, to what is polled beside urgent requests */
    struct md_before before;
    struct md_row_queue *row_queue;
    uint32_t number; /* there */
    int lost_error;
    struct md_progress progress; /* its counters have one writer each, and are read atomically */
    struct md_line line;
    struct md_completion completion;
};

void md_turn_init(struct md_turn *turn, struct md_slot *slots, uint32_t room, int64_t now_ns);
/* The same as md_port_submit() and its like. */
int md_turn_submit(struct md_turn *turn, const struct md_exchange *const *exchanges,
                   const int64_t *not_before_ns, int n);
uint32_t md_turn_repeat(struct md_turn *turn, const struct md_exchange *const *exchanges, uint32_t n);
void md_turn_add_urgent(struct md_turn *turn, struct md_urgent *urgent);
void md_turn_tell_echo(struct md_turn *turn, int echo);
int md_turn_end(struct md_turn *turn);
int md_turn_is_asking(const struct md_turn *turn, const struct md_drive *drive);
int64_t md_turn_counted_ns(const struct md_turn *turn, int64_t now_ns);
/* Return what the line wants (enum md_want); MD_DONE: there is nothing to carry out before wake_ns. */
int md_turn_want(struct md_turn *turn, int64_t *wake_ns, int64_t now_ns);
void md_turn_lose(struct md_turn *turn, int error); /* the port failed */
void md_turn_close(struct md_turn *turn);           /* end everything */
/* cdef: end */

/* ---- port_before.c: requests sent before an exchange ---- */

/* Return what to send before the exchange; NULL: it is its turn. */
const struct md_exchange *md_before_find(struct md_before *before, const struct md_exchange *exchange,
                                         int is_echo_in_doubt, int64_t now_ns);
/* Its turn is over; 1: its reply may have been an earlier one, and it is sent again. */
int md_before_is_again(struct md_before *before, const struct md_exchange *exchange,
                       const struct md_completion *completion);

/* ---- port_queue.c, port_turn.c: numbers with one writer, and readers on other threads ---- */

static inline uint32_t md_load(const uint32_t *counter)
{
    return __atomic_load_n(counter, __ATOMIC_SEQ_CST);
}

static inline void md_store(uint32_t *counter, uint32_t value)
{
    __atomic_store_n(counter, value, __ATOMIC_SEQ_CST);
}

#endif
