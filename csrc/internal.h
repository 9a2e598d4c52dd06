/* What only C calls of the core. The marked part is also there for the tests. */
#ifndef MULTIDROP_INTERNAL_H
#define MULTIDROP_INTERNAL_H

#include "multidrop.h"

#include <stdatomic.h>

/* cdef: begin */
/* ---- line.c: one line as a state machine; bytes and time come in as arguments ---- */

enum { MD_RX_ROOM = 2 * MD_MOST_FRAME };

enum md_want {
    MD_DONE,  /* nothing: the completion is filled in */
    MD_WAIT,  /* to be left alone until wake_ns: nothing worth reading comes before */
    MD_WRITE, /* tx[tx_at] to tx[tx_len] written, as much as the port takes */
    MD_READ   /* bytes, or to be asked again at wake_ns */
};

struct md_line {
    int state;
    int64_t quiet_ns;   /* the line's last activity */
    int64_t silence_ns; /* demanded after it */
    int64_t wake_ns;
    int64_t give_up_ns; /* end of the wait for a babbling line to fall silent, or for the reply */
    int64_t begun_by_ns; /* the reply has begun by then, or it does not come in time */
    int64_t ready_ns;   /* before then nothing is worth reading */
    struct md_drive *late; /* the first drive with late replies due */
    const struct md_exchange *exchange;
    struct md_completion *completion;
    uint16_t tx_len, tx_at;
    uint16_t rx_len, rx_from; /* no reply begins before rx_from */
    int echo;                 /* of the adapter (enum md_echo): learnt, never forgotten by failures */
    int echo_is_told;         /* to be there, and is not unlearnt */
    int echo_due;             /* a copy of the request is still to come, and is not its reply */
    int waited, looks;        /* since the request left: a wait was granted; looks at the port */
    struct md_tap *tap;       /* gets all that goes over the line; NULL: none */
    uint32_t cut;             /* bytes of late replies since the request left */
    uint16_t sight_at, sight; /* where the reply may begin, and how much of it was there at first sight */
    uint16_t burst;           /* most characters that wait in the adapter; 0: it may be a whole reply */
    uint8_t tx[MD_MOST_FRAME], rx[MD_RX_ROOM];
};

void md_line_init(struct md_line *line, int64_t now_ns);
/* Take up an exchange; one that is barred by late replies ends at once. Nothing happens before the line's silence
 * is over. */
void md_line_begin(struct md_line *line, const struct md_exchange *exchange, struct md_completion *completion,
                   int64_t now_ns);
int md_line_want(struct md_line *line, int64_t now_ns); /* enum md_want */
/* The port took bytes, some time between these two. */
void md_line_sent(struct md_line *line, size_t len, int64_t begun_ns, int64_t now_ns);
void md_line_received(struct md_line *line, const uint8_t *bytes, size_t len, int64_t now_ns);
/* End the exchange under way: the port failed, or it is not to be sent any more. */
void md_line_abandon(struct md_line *line, int result, int error);

/* ---- before.c: what is sent before an exchange ---- */

/* Zeroed, nothing was. */
struct md_before {
    const struct md_exchange *then; /* the exchange */
    uint64_t heard;                 /* replies of its drive, before the last proof */
    uint32_t proofs, is_told;       /* proofs sent; its echo probe was sent */
    uint32_t failures;              /* of its drive, before all of that */
};

/* Return what to send next before the exchange; NULL: it is its turn. */
const struct md_exchange *md_before(struct md_before *before, const struct md_exchange *exchange, int echo, int64_t now_ns);
/* Its turn is over; 1: its reply may have been an earlier one, and it is to be sent again. */
int md_is_asked_again(struct md_before *before, const struct md_exchange *exchange, const struct md_completion *completion);

/* ---- counters.c ---- */

/* Count an exchange that is over. */
void md_counters_end(struct md_counters *counters, const struct md_exchange *exchange, const struct md_completion *completion);
/* Count its reply, which came after this delay and needed so long of the line. */
void md_counters_answer(struct md_counters *counters, int64_t delay_ns, int64_t ideal_ns);

/* ---- columns.c, row_queue.c ---- */

/* Append one row for each of the block's fields; return how many, 0 when there is no room. */
int md_columns_add(struct md_columns *columns, const struct md_block *block, const struct md_completion *completion,
                   int64_t utc_minus_monotonic_ns);
/* The same to the newest chunk; a block that is NULL has no rows. */
void md_row_queue_add(struct md_row_queue *row_queue, const struct md_block *block, const struct md_completion *completion);
/* cdef: end */

/* ---- frame.c, reason.c ---- */

enum { MD_MOST_ADDRESS = 247 };

enum { MD_WRITE_COIL = 0x05, MD_WRITE_ONE = 0x06, MD_LOOPBACK = 0x08 };

/* Delixi's K (part 3): a master sends these, and those between them. */
enum { MD_DELIXI_RUN = 2, MD_DELIXI_STATE_QUERY = 3, MD_DELIXI_PARAMETER_QUERY = 7 };

/* Numbers in frames are big-endian. */
static inline uint16_t md_get16(const uint8_t *at)
{
    return (uint16_t)(at[0] << 8 | at[1]);
}

static inline uint8_t *md_put16(uint8_t *at, unsigned value)
{
    at[0] = (uint8_t)(value >> 8);
    at[1] = (uint8_t)value;
    return at + 2;
}

/* Copy only the data that the message has: most are much shorter than the longest. */
void md_copy_message(struct md_message *to, const struct md_message *from);
int md_hex_byte(const uint8_t digits[2]); /* value of two upper-case hex digits; -1 where they are none */
/* Return why these bytes, which came in place of the reply, are none: an enum md_frame_fault, MD_CUT_SHORT or
 * MD_NO_REPLY. */
int md_reason(int framing, const struct md_message *request, const uint8_t *bytes, size_t len);

/* ---- delay.c: what is learnt of a drive from the delays of its replies ---- */

/* How long after a request, beside its reply's own time, it is worth looking for that. */
int64_t md_look_ns(const struct md_drive *drive, int64_t character_ns);
int64_t md_timeout_ns(const struct md_exchange *exchange);
/* Learn from a reply's delay (the longest possible, where the reply was whole when first looked at); return what
 * to take for its delay. */
int64_t md_learn_delay(struct md_drive *drive, int64_t delay_ns, int is_whole, int64_t character_ns);
/* Learn from a late reply, so long after its request or after the last of several: wait longer from now on. */
void md_learn_lateness(struct md_drive *drive, int64_t delay_ns, int is_exact);
/* Learn from a time-out, which takes back half of that. */
void md_learn_silence(struct md_drive *drive);
int64_t md_window_ns(const struct md_exchange *exchange); /* in which a late reply may come in any order */

/* ---- late.c: replies that come after their time-out ---- */

/* Return the proof to ask for first, so that no late reply can be taken for this exchange's; NULL: none is needed,
 * or none would help. */
const struct md_exchange *md_late_proof(const struct md_exchange *exchange, int64_t now_ns);
/* A late reply could be taken for its own, and it may not be sent now. */
int md_late_bars(const struct md_exchange *exchange, int64_t now_ns);
/* A reply to the same request is outstanding: then a second copy of it is no adapter's echo. */
int md_late_is_repeated(const struct md_exchange *exchange);
/* The exchange under way is over, and its reply may still come: for so long in any order. */
void md_late_expect(struct md_line *line, int64_t window_ns);
/* Replies of this drive may still come to requests on another line, or before the port was lost. */
void md_late_resume(struct md_line *line, struct md_drive *drive);
/* Account for the late reply that begins there: its length, MD_INCOMPLETE, or MD_NO_START. Where it may answer
 * the exchange under way instead, `since_ns` is to have the time at which that was sent first, 0 if it never
 * was; else NULL. */
int md_late_take(struct md_line *line, size_t at, int64_t now_ns, int64_t *since_ns);
/* The reply is an exception, or its one register lies between these; `most` 0: anything. */
int md_is_in_range(const struct md_message *reply, uint16_t least, uint16_t most);
int md_is_read(int framing, uint8_t function);

/* The clients read it meanwhile. */
static inline void md_count_failures(struct md_drive *drive, uint32_t failures)
{
    __atomic_store_n(&drive->failures, failures, __ATOMIC_RELAXED);
}

/* ---- tap.c, unpack.c ---- */

/* The enhanced packet block of a pcapng file (draft-ietf-opsawg-pcapng, 4.3). */
enum {
    MD_PACKET_BLOCK = 6,
    MD_PACKET_HEAD = 28, /* bytes before a packet */
    MD_PACKET_END = 4    /* and behind it */
};

void md_tap_put(struct md_tap *tap, int side, int64_t time_ns, const uint8_t *bytes, size_t len);

/* ---- waiter_epoll.c, or waiter_poll.c where the system is not Linux: wait for many descriptors ---- */

struct md_waiter;

struct md_waiter *md_waiter_new(void); /* NULL: see errno */
void md_waiter_free(struct md_waiter *waiter);
/* Report `whose` from now on when the descriptor can be read; -1: see errno. */
int md_waiter_add(struct md_waiter *waiter, int fd, void *whose);
/* Stop watching a descriptor for a while, or watch it again. */
void md_waiter_change(struct md_waiter *waiter, int fd, void *whose, int watched);
void md_waiter_remove(struct md_waiter *waiter, int fd);
/* Wait so long, for ever where it is negative; write who can read, and return how many. */
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

/* ---- times ---- */

static inline int64_t later(int64_t a, int64_t b)
{
    return a > b ? a : b;
}

static inline int64_t sooner(int64_t a, int64_t b)
{
    return a < b ? a : b;
}

#endif
