/* One line, and the replies, late replies and echoes on it. Tests see the marked part, too. */
#ifndef MULTIDROP_LINE_H
#define MULTIDROP_LINE_H

#include "internal.h"

/* cdef: start */
/* ---- line.c: its states ---- */

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

/* The state that follows on an event; -1 where the event cannot happen. */
extern const int8_t md_line_follows[MD_LINE_STATES][MD_LINE_EVENTS];

/* ---- line.c: one line as a state machine; bytes and time come in as arguments ---- */

enum { MD_RX_ROOM = 2 * MD_MOST_FRAME };

enum md_want {
    MD_DONE,  /* nothing: the completion is filled in */
    MD_WAIT,  /* to be left alone until wake_ns: nothing worth reading comes before */
    MD_WRITE, /* tx[tx_at] to tx[tx_len] written, as much as the port takes */
    MD_READ   /* bytes, or to be asked again at wake_ns */
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
    int64_t listened_ns; /* nothing but a stop is sent before then; 0: the line is not listened to */
    int64_t listen_ns;   /* how long from the last byte that came */
    int64_t wake_ns;
    int64_t give_up_ns;  /* end of the wait for a babbling line to fall silent, or for the reply */
    int64_t begun_by_ns; /* the reply has begun by then, or it does not come in time */
    int64_t looked_ns;   /* the last look at what came */
    int64_t missing_ns;  /* the last look at which less than a copy of the request had come; 0: none */
    int64_t copy_by_ns;  /* an echo would be whole by then; 0: unknown */
    int64_t ready_ns;    /* before then nothing is worth reading */
    struct md_drive *late; /* the first drive with late replies due */
    struct md_tap *tap;  /* gets all that goes over the line; NULL: none */
    uint8_t echo;        /* of the adapter (enum md_echo): learnt, never forgotten by failures */
    uint8_t echo_is_told; /* to be there, and is not unlearnt */
    uint8_t echo_due;    /* a copy of the request is still to come, and is not its reply */
    uint8_t lone_copies; /* in a row that were taken for replies, up to a bound */
    uint8_t transactions; /* enum md_transactions; the line is told before its first exchange */
    uint8_t is_out_of_step; /* what came is no header of Modbus TCP: the port is to be lost */
    uint8_t is_adrift;      /* a frame's length was not its header's: look for the next head */
    uint8_t is_proven;      /* a good reply came on this port */
    uint8_t is_quicker;     /* a reply came sooner than its characters could over a wire */
    uint8_t waited;      /* since the request left a wait was granted */
    uint32_t looks;      /* at the port, since then */
    uint32_t cut;        /* bytes of late replies, since then */
    uint32_t foreign;    /* bytes that came while it was listened to */
    uint16_t sight_at, sight; /* where the reply may begin, and how much of it was there at first sight */
    uint16_t burst;      /* most characters that wait in the adapter; 0: it may be a whole reply */
    uint8_t rx[MD_RX_ROOM];
    uint8_t long_tx[MD_MOST_FRAME]; /* of a request that its exchange does not keep */
    uint16_t transaction;           /* of the last request */
    uint16_t frame_len, frame_told; /* of a frame of Modbus TCP that is not whole; of these, reported */
    uint8_t frame[MD_MOST_TCP];
};

void md_line_init(struct md_line *line, int64_t now_ns);
/* Take up an exchange; one that is barred by late replies ends at once. Nothing happens before the line's
 * silence is over. */
void md_line_begin(struct md_line *line, const struct md_exchange *exchange, struct md_completion *completion,
                   int64_t now_ns);
int md_line_want(struct md_line *line, int64_t now_ns); /* enum md_want */
int64_t md_line_silent_ns(const struct md_line *line);  /* no request leaves before then */
/* The port took bytes, some time between these two. */
void md_line_sent(struct md_line *line, size_t len, int64_t begun_ns, int64_t now_ns);
void md_line_received(struct md_line *line, const uint8_t *bytes, size_t len, int64_t now_ns);
/* End the exchange under way: the port failed, or it is not to be sent any more. */
void md_line_abandon(struct md_line *line, int result, int error);

/* ---- line.c: is there another master? ---- */

/* Listen before the request that is ready to leave, for the time that the longest frame and the drive's
 * time-out take, and for the guard at least; on a network, which has no frames of others, for that alone.
 * Return 0 where there is nothing to wait for. */
int md_listen_begin(struct md_line *line, int64_t now_ns, int64_t guard_ns);
void md_listen_put_back(struct md_line *line); /* an exchange that waits for it, as if it had never begun */

/* ---- turn.c: whose turn it is on a line; I/O and time come from outside ---- */

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

/* ---- line.c: its states ---- */

/* Go where the table says; an event that cannot happen now changes nothing. */
static inline void md_line_go(struct md_line *line, enum md_line_event event)
{
    int next = md_line_follows[line->state][event];
    if (next >= 0)
        line->state = next;
}

/* ---- line.c, of a line that is listened to ---- */

void md_listen_hear(struct md_line *line, size_t len, int64_t now_ns); /* bytes came */

/* The exchange under way waits for the end of the listening, as all but stops do. */
static inline int md_listen_is_held(const struct md_line *line)
{
    return line->listened_ns && line->state != MD_IDLE && !line->exchange->insists;
}

/* The end of an exchange: its result, and the bytes that the completion keeps. */
struct md_ending {
    int result;
    size_t at, len;
};

/* At least a part of the request has left. */
static inline int md_line_is_under_way(const struct md_line *line)
{
    return line->state >= MD_WRITING;
}

/* ---- reply.c: the reply among the bytes that came since the request left ---- */

/* Begin to wait for a reply of this length. */
void md_reply_await(struct md_line *line, int reply_len);
/* Look for the reply in what was received; 1: the exchange ends. */
int md_reply_find(struct md_line *line, int64_t now_ns, struct md_ending *ending);
/* Look away from the port until the rest of a reply that has begun can be there. */
void md_reply_foresee(struct md_line *line, int64_t now_ns);
/* Anything came, but at most the request's echo. */
int md_reply_has_begun(const struct md_line *line);
/* End the exchange at its time-out. */
struct md_ending md_reply_missed(struct md_line *line, int64_t now_ns);
/* Recognise late replies among stray bytes, from here on; what follows is looked for behind them. */
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
/* A frame that has begun to come is no reply to the request that leaves now. */
void md_tcp_disown(struct md_line *line);
/* Take in bytes, up to the end of a frame; return how many. */
size_t md_tcp_put(struct md_line *line, const uint8_t *bytes, size_t len, int64_t now_ns);
/* Look at the frame, if it is whole; 1: the exchange ends. */
int md_tcp_find(struct md_line *line, int64_t now_ns, struct md_ending *ending);
/* End the exchange at its time-out. */
struct md_ending md_tcp_missed(struct md_line *line);

/* ---- reply.c: adapters that repeat what they send ---- */

/* A copy of the request may come that is not its reply. */
int md_echo_is_due(const struct md_line *line, int reply_len);
/* A copy of the request is there. */
int md_echo_is_copy(const struct md_line *line, size_t at);
/* An echo probe is to be sent first. */
int md_echo_is_in_doubt(const struct md_line *line);
/* Drop what came while the request was leaving, but the beginning of its echo. */
void md_echo_keep(struct md_line *line);

/* The reply is an exception, or its one register is at least this and below `end`; `end` 0: anything. */
int md_is_in_range(const struct md_message *reply, uint16_t least, uint32_t end);
int md_is_read(int framing, uint8_t function);

int md_proof_is(const struct md_exchange *exchange);
/* An exchange has ended, and may be a proof. */
void md_proof_end(const struct md_exchange *exchange, int result);

/* ---- late.c: replies that come after their time-out ---- */

/* Return the proof to ask for first, so that no late reply can be taken for this exchange's; NULL: none is
 * needed, or none would help. */
const struct md_exchange *md_late_proof(const struct md_exchange *exchange, int64_t now_ns);
/* The reply may answer what another process asked. */
int md_late_is_in_doubt(const struct md_exchange *exchange, const struct md_message *reply);
/* A late reply could be taken for its own, and it may not be sent now. */
int md_late_bars(const struct md_exchange *exchange, int64_t now_ns);
/* A reply to the same request is outstanding: then a second copy of it is no adapter's echo. */
int md_late_is_repeated(const struct md_exchange *exchange);
/* The exchange under way is over, and its reply may still come: for so long in any order. */
void md_late_expect(struct md_line *line, int64_t window_ns);
/* The drive's first reply came: it may be another's, and the exchange's own may still come. */
void md_late_doubt(struct md_line *line);
/* The drive has requests whose replies may come on this line. */
void md_late_link(struct md_line *line, struct md_drive *drive);
/* Account for the late reply that begins there: its length, MD_INCOMPLETE, or MD_NO_START. Where it may
 * answer the exchange under way instead, `since_ns` is to have the time at which that was sent first, 0 if
 * it never was; else NULL. */
int md_late_take(struct md_line *line, size_t at, int64_t now_ns, int64_t *since_ns);

/* ---- numbers with one writer, and readers on other threads ---- */

static inline uint32_t md_load(const uint32_t *counter)
{
    return __atomic_load_n(counter, __ATOMIC_SEQ_CST);
}

static inline void md_store(uint32_t *counter, uint32_t value)
{
    __atomic_store_n(counter, value, __ATOMIC_SEQ_CST);
}

#endif
