/* The functions that only C calls. Tests see the marked part, too. */
#ifndef MULTIDROP_INTERNAL_H
#define MULTIDROP_INTERNAL_H

#include "multidrop.h"

#include <stdatomic.h>
#include <time.h>

/* cdef: begin */
/* ---- line.c: one line as a state machine; bytes and time come in as arguments ---- */

enum { MD_RX_ROOM = 2 * MD_MOST_FRAME, MD_MOST_TCP = 260 };

enum md_want {
    MD_DONE,  /* nothing: the completion is filled in */
    MD_WAIT,  /* to be left alone until wake_ns: nothing worth reading comes before */
    MD_WRITE, /* tx[tx_at] to tx[tx_len] written, as much as the port takes */
    MD_READ   /* bytes, or to be asked again at wake_ns */
};

enum md_line_state {
    MD_IDLE,
    MD_SILENCE,   /* waits until the line has been silent for long enough */
    MD_CHECK,     /* looks once for bytes that came meanwhile */
    MD_READY,     /* the request may be written */
    MD_WRITING,   /* a part of it has left */
    MD_AWAITING,  /* the reply, or its rest */
    MD_LAST_LOOK, /* the time-out is over: looks once more, because it may be late to look at all */
    MD_LINE_STATES
};

enum md_line_event {
    MD_BEGUN,         /* an exchange was taken up */
    MD_FELL_SILENT,   /* or babbles for too long */
    MD_NOTHING_CAME,
    MD_STRAY_BYTES,   /* came before the request left, while there is time to wait for silence again */
    MD_PART_LEFT,
    MD_ALL_LEFT,
    MD_TIME_OUT,
    MD_BYTES_IN_TIME, /* came, but not yet the reply, and there is time left */
    MD_ENDED,         /* the completion is filled in */
    MD_LINE_EVENTS
};

struct md_line {
    int state;           /* enum md_line_state */
    uint16_t tx_len, tx_at;
    uint16_t rx_len, rx_from; /* no reply begins before rx_from */
    const uint8_t *tx;   /* the request */
    const struct md_exchange *exchange;
    struct md_completion *completion;
    int64_t quiet_ns;    /* the line's last activity */
    int64_t silence_ns;  /* demanded after it */
    int64_t wake_ns;
    int64_t give_up_ns;  /* end of the wait for a babbling line to fall silent, or for the reply */
    int64_t begun_by_ns; /* the reply has begun by then, or it does not come in time */
    int64_t ready_ns;    /* before then nothing is worth reading */
    struct md_drive *late; /* the first drive with late replies due */
    struct md_tap *tap;  /* gets all that goes over the line; NULL: none */
    uint8_t echo;        /* of the adapter (enum md_echo): learnt, never forgotten by failures */
    uint8_t echo_is_told; /* to be there, and is not unlearnt */
    uint8_t echo_due;    /* a copy of the request is still to come, and is not its reply */
    uint8_t transactions; /* enum md_transactions; the line is told before its first exchange */
    uint8_t is_out_of_step; /* what came is no header of Modbus TCP: the port is to be lost */
    uint8_t waited;      /* since the request left a wait was granted */
    uint32_t looks;      /* at the port, since then */
    uint32_t cut;        /* bytes of late replies, since then */
    uint16_t sight_at, sight; /* where the reply may begin, and how much of it was there at first sight */
    uint16_t burst;      /* most characters that wait in the adapter; 0: it may be a whole reply */
    uint8_t rx[MD_RX_ROOM];
    uint8_t long_tx[MD_MOST_FRAME]; /* of a request that its exchange does not keep */
    uint16_t transaction;           /* of the last request */
    uint16_t frame_len, frame_told; /* of a frame of Modbus TCP that is not whole; of these, reported */
    uint8_t frame[MD_MOST_TCP];
};

/* Return the state that follows on an event; -1 where the event cannot happen. */
int md_line_follows(int state, int event);
void md_line_init(struct md_line *line, int64_t now_ns);
/* Take up an exchange; one that is barred by late replies ends at once. Nothing happens before the line's
 * silence is over. */
void md_line_begin(struct md_line *line, const struct md_exchange *exchange, struct md_completion *completion,
                   int64_t now_ns);
int md_line_want(struct md_line *line, int64_t now_ns); /* enum md_want */
/* The port took bytes, some time between these two. */
void md_line_sent(struct md_line *line, size_t len, int64_t begun_ns, int64_t now_ns);
void md_line_received(struct md_line *line, const uint8_t *bytes, size_t len, int64_t now_ns);
/* End the exchange under way: the port failed, or it is not to be sent any more. */
void md_line_abandon(struct md_line *line, int result, int error);

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
    int64_t not_before_ns, expires_ns; /* 0: at once; never */
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
/* Return what the line wants (enum md_want); MD_DONE: there is nothing to carry out before wake_ns. */
int md_turn_want(struct md_turn *turn, int64_t *wake_ns, int64_t now_ns);
void md_turn_lose(struct md_turn *turn, int error); /* the port failed */
void md_turn_close(struct md_turn *turn);           /* end everything */

/* ---- counters.c ---- */

/* Count an exchange that is over. */
void md_counters_end(const struct md_exchange *exchange, const struct md_completion *completion);
/* Count its reply, which came after this delay and needed so long of the line. */
void md_counters_answer(struct md_drive *drive, int64_t delay_ns, int64_t ideal_ns);
const uint64_t *md_usual_delays(const struct md_drive *drive); /* replies of the usual delay */

/* ---- columns.c, row_queue.c ---- */

/* Append one row for each of the block's fields; return how many, 0 when there is no room. */
int md_columns_add(struct md_columns *columns, const struct md_block *block,
                   const struct md_completion *completion, int64_t utc_minus_monotonic_ns);
/* Return how many of the block's fields have no value in a good reply. */
uint64_t md_count_lacking(const struct md_block *block, const struct md_message *reply);
/* Append to the newest chunk; a block that is NULL has no rows. */
void md_row_queue_add(struct md_row_queue *row_queue, const struct md_block *block,
                      const struct md_completion *completion);
/* cdef: end */

/* ---- body.c: what is wrapped in a frame, from its address on ---- */

enum { MD_MOST_BODY = 253 }; /* 125 registers read; the standard has room for 254 */

/* Return the length of the body that begins there: a request's, or a reply's to `request`. MD_INCOMPLETE where
 * its first bytes do not tell yet. */
int md_body_length(int framing, const uint8_t *body, size_t have, const struct md_message *request);
int md_body_reply_length(int framing, const struct md_message *request); /* of the good reply; 0: none comes */
/* Write what follows on address and function, and return the whole length; MD_BAD_REQUEST where no body can
 * say it. */
int md_body_put_request(int framing, const struct md_message *message, uint8_t *body);
int md_body_put_reply(int framing, const struct md_message *message, uint8_t *body);
void md_body_get_request(int framing, const uint8_t *body, struct md_message *message);
/* Read a whole reply; MD_BAD_ECHO where it confirms what was not asked for, else 0. */
int md_body_get_reply(int framing, const uint8_t *body, const struct md_message *request,
                      struct md_message *reply);

/* ---- frame.c, reason.c ---- */

enum { MD_MOST_ADDRESS = 247, MD_TCP_HEAD = 6 /* before the unit id, which is the address */ };

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
/* Return the length that a header of Modbus TCP announces, an enum md_frame_fault where it is none. */
int md_tcp_length(const uint8_t *bytes, size_t len);
/* A gateway has no path to the drive, or no reply from it: the drive itself said nothing. */
int md_is_gateways(int framing, const struct md_message *reply);
/* Return why these bytes, which came in place of the reply, are none: an enum md_frame_fault, MD_CUT_SHORT or
 * MD_NO_REPLY. */
int md_reason(int framing, const struct md_message *request, const uint8_t *bytes, size_t len);

/* ---- delay.c: what is learnt of a drive from the delays of its replies ---- */

/* Return the time after a request, beside its reply's own, before which it is not worth looking for that. */
int64_t md_look_ns(const struct md_drive *drive, int64_t character_ns);
int64_t md_timeout_ns(const struct md_exchange *exchange);
/* Learn from a reply's delay (the longest possible, where the reply was whole when first looked at);
 * return what to take for its delay. */
int64_t md_learn_delay(struct md_drive *drive, int64_t delay_ns, int is_whole, int64_t character_ns);
/* Learn from a late reply, so long after its request or after the last of several: wait longer from now
 * on. */
void md_learn_lateness(struct md_drive *drive, int64_t delay_ns, int is_exact);
/* Learn from a time-out, which takes back half of that. */
void md_learn_silence(struct md_drive *drive);
int64_t md_window_ns(const struct md_exchange *exchange); /* in which a late reply may come in any order */

/* ---- late.c: replies that come after their time-out ---- */

/* Return the proof to ask for first, so that no late reply can be taken for this exchange's; NULL: none is
 * needed, or none would help. */
const struct md_exchange *md_late_proof(const struct md_exchange *exchange, int64_t now_ns);
/* A late reply could be taken for its own, and it may not be sent now. */
int md_late_bars(const struct md_exchange *exchange, int64_t now_ns);
/* A reply to the same request is outstanding: then a second copy of it is no adapter's echo. */
int md_late_is_repeated(const struct md_exchange *exchange);
/* The exchange under way is over, and its reply may still come: for so long in any order. */
void md_late_expect(struct md_line *line, int64_t window_ns);
/* The drive has requests whose replies may come on this line. */
void md_late_link(struct md_line *line, struct md_drive *drive);
/* Replies of this drive may still come to requests on another line, or before the port was lost. */
void md_late_resume(struct md_line *line, struct md_drive *drive);
/* Account for the late reply that begins there: its length, MD_INCOMPLETE, or MD_NO_START. Where it may
 * answer the exchange under way instead, `since_ns` is to have the time at which that was sent first, 0 if
 * it never was; else NULL. */
int md_late_take(struct md_line *line, size_t at, int64_t now_ns, int64_t *since_ns);
/* The reply is an exception, or its one register lies between these; `most` 0: anything. */
int md_is_in_range(const struct md_message *reply, uint16_t least, uint16_t most);
int md_is_read(int framing, uint8_t function);

/* The clients read it meanwhile. */
static inline void md_count_failures(struct md_drive *drive, uint32_t failures)
{
    if (drive->failures != failures)
        __atomic_store_n(&drive->failures, failures, __ATOMIC_RELAXED);
}

/* ---- reply.c: the reply among the bytes that came since the request left ---- */

/* The end of an exchange: its result, and the bytes that the completion keeps. */
struct md_ending {
    int result;
    size_t at, len;
};

/* Begin to wait for a reply of this length. */
void md_reply_await(struct md_line *line, int reply_len);
/* Look for the reply in what was received; 1: the exchange ends. */
int md_reply_find(struct md_line *line, int64_t now_ns, struct md_ending *ending);
/* Look away from the port until the rest of a reply that has begun can be there. */
void md_reply_foresee(struct md_line *line, int64_t now_ns);
/* Anything came, but at most the request's echo. */
int md_reply_has_begun(const struct md_line *line);
/* End the exchange at its time-out. */
struct md_ending md_reply_missed(struct md_line *line);
/* Recognise late replies among stray bytes, from here on. */
void md_reply_find_late(struct md_line *line, size_t from, int64_t now_ns);

/* Take the reply that was found there for this exchange's; 0: it was cut out as a late one. */
int md_reply_judge(struct md_line *line, size_t at, int used, const struct md_message *reply, int64_t now_ns,
                   struct md_ending *ending);
void md_reply_accept(struct md_line *line, size_t at, int used, const struct md_message *reply);
/* A late reply came meanwhile: the reply may be as late. */
void md_reply_extend(struct md_line *line);
int md_reply_parse(const struct md_line *line, size_t at, struct md_message *reply);
/* Take out what is no part of this exchange. */
void md_reply_cut_out(struct md_line *line, size_t at, size_t len);

/* Return the time that a frame takes on the drive's own wire, behind a gateway if there is one. */
static inline int64_t md_wire_ns(const struct md_exchange *exchange, int64_t len)
{
    enum { LONGER_THAN_RTU = 4 }; /* six bytes before it, and no CRC of two */
    return (exchange->framing == MD_TCP ? len - LONGER_THAN_RTU : len) * exchange->character_ns;
}

/* ---- tcp.c: frames of Modbus TCP, a stream, and whose replies they are ---- */

/* Give the request that is about to leave a transaction of its own. */
void md_tcp_begin(struct md_line *line);
/* Take in bytes, up to the end of a frame; return how many. */
size_t md_tcp_put(struct md_line *line, const uint8_t *bytes, size_t len);
/* Look at the frame, if it is whole; 1: the exchange ends. */
int md_tcp_find(struct md_line *line, int64_t now_ns, struct md_ending *ending);
/* End the exchange at its time-out. */
struct md_ending md_tcp_missed(struct md_line *line);

/* ---- echo.c: adapters that repeat what they send ---- */

/* A copy of the request is there. */
int md_echo_is_copy(const struct md_line *line, size_t at);
/* All that is there begins as the request does, and is shorter. */
int md_echo_may_follow(const struct md_line *line, size_t at);
/* Learn from a reply that is no copy of its request. */
void md_echo_learn(struct md_line *line, size_t reply_at);
/* Learn from a copy that is all that came before the time-out; 1: it may have been the reply. */
int md_echo_learn_alone(struct md_line *line, int is_reply);
/* Drop what came while the request was leaving, but the beginning of its echo. */
void md_echo_keep(struct md_line *line);

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

#define MD_NEVER INT64_MAX
#define MD_SECOND_NS INT64_C(1000000000)

/* Its fields are 32 bits wide on some systems. */
static inline struct timespec timespec_of(int64_t ns)
{
    return (struct timespec){.tv_sec = (time_t)(ns / MD_SECOND_NS), .tv_nsec = (long)(ns % MD_SECOND_NS)};
}

static inline int64_t later(int64_t a, int64_t b)
{
    return a > b ? a : b;
}

static inline int64_t sooner(int64_t a, int64_t b)
{
    return a < b ? a : b;
}

#endif
