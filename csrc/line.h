/* One line with its replies, late replies, echoes and turns. Python tests can also use the declarations
 * between the `cdef` marks. */
#ifndef MULTIDROP_LINE_H
#define MULTIDROP_LINE_H

#include "internal.h"

/* cdef: start */
/* ---- line.c: states ---- */

enum md_line_state {
    MD_IDLE,
    MD_SILENCE,   /* wait for the line to be silent for long enough */
    MD_CHECK,     /* read once, in case bytes came during the silence */
    MD_READY,     /* the request may be written now */
    MD_WRITING,   /* part of the request has been written */
    MD_AWAITING,  /* wait for the reply or its remaining bytes */
    MD_LAST_LOOK, /* after the timeout: read once more, because the thread may be late */
    MD_LINE_STATES
};

enum md_line_event {
    MD_BEGUN,         /* an exchange starts */
    MD_FELL_SILENT,   /* the wait for silence is over: the line was silent, or the deadline passed */
    MD_NOTHING_CAME,  /* no bytes came during the silence */
    MD_STRAY_BYTES,   /* bytes came before the request, and there is time to wait for silence again */
    MD_PART_LEFT,     /* the port took a part of the request */
    MD_ALL_LEFT,      /* the port took all of the request */
    MD_TIME_OUT,      /* the deadline for the reply passed */
    MD_BYTES_IN_TIME, /* bytes came before the timeout, but not the whole reply */
    MD_ENDED,         /* the completion is filled in */
    MD_LINE_EVENTS
};

/* The next state for each state and event; -1: the event cannot happen. */
extern const int8_t md_line_follows[MD_LINE_STATES][MD_LINE_EVENTS];

/* ---- line.c: one line as a state machine; bytes and times are arguments ---- */

enum { MD_RX_ROOM = 2 * MD_MOST_FRAME };

enum md_want {
    MD_DONE,  /* the completion is filled in */
    MD_WAIT,  /* wait until wake_ns; no useful bytes come before that */
    MD_WRITE, /* write tx[tx_at] to tx[tx_len], as much as the port takes */
    MD_READ   /* read when bytes come; call again at wake_ns at the latest */
};

struct md_line {
    int state;           /* enum md_line_state */
    uint16_t tx_len, tx_at;
    uint16_t rx_len, rx_from; /* number of bytes in rx; index at which the search for the reply starts */
    const uint8_t *tx;   /* the request */
    const struct md_exchange *exchange;
    struct md_completion *completion;
    int64_t quiet_ns;    /* time of the line's last activity */
    int64_t silence_ns;  /* required duration of silence after quiet_ns */
    int64_t listened_ns; /* end of listening; until then only stops are sent; 0: not listening */
    int64_t listen_ns;   /* required silence while listening */
    int64_t wake_ns;
    int64_t give_up_ns;  /* deadline of the wait for silence, or for the reply */
    int64_t begun_by_ns; /* deadline of the reply's first byte */
    int64_t looked_ns;   /* time of the last read of the port */
    int64_t missing_ns;  /* time of the last read that found no whole copy of the request; 0: none */
    int64_t copy_by_ns;  /* time by which an echo would be whole; 0: unknown */
    int64_t ready_ns;    /* earliest time at which the whole reply can have come: do not read before */
    struct md_drive *late; /* list of the drives whose late replies may still come */
    struct md_tap *tap;  /* receives a copy of all bytes of the line; NULL: no tap */
    uint8_t echo;        /* enum md_echo, learnt; failed exchanges do not reset it */
    uint8_t echo_is_configured; /* 1: the user stated that the adapter echoes: `echo` is final */
    uint8_t echo_due;    /* 1: the adapter's copy of the request is still to come */
    uint8_t lone_copies; /* consecutive replies that were copies of their requests; see MOST_LONE_COPIES */
    uint8_t transactions; /* enum md_transactions, set before the first exchange */
    uint8_t is_out_of_step; /* 1: the received bytes are not Modbus TCP, so the port is given up */
    uint8_t is_adrift;      /* 1: a frame's length contradicted its header: search for the next header */
    uint8_t is_proven;      /* 1: a good reply came on this port */
    uint8_t is_quicker;     /* 1: a reply came faster than a wire can carry it */
    uint8_t waited;      /* 1: md_line_want() has returned MD_WAIT since the request was sent */
    uint8_t is_held;     /* 1: the request is a read that waits until the adapter has taken earlier bytes */
    uint8_t is_answered; /* 1: the last request was answered, and the reply cannot be to an earlier one */
    uint32_t looks;      /* number of reads of the port since the request was sent */
    uint32_t cut;        /* bytes of late replies since the request was sent */
    uint32_t foreign;    /* bytes received while listening */
    uint16_t sight_at, sight; /* index at which the reply may start; number of its bytes in the first read */
    uint16_t burst;      /* limit of characters that the adapter delivers together; 0: unknown, maybe all */
    uint8_t rx[MD_RX_ROOM];
    uint8_t long_tx[MD_MOST_FRAME]; /* bytes of a request too long to be stored in its exchange */
    uint16_t transaction;           /* transaction id of the last request */
    uint16_t frame_len, frame_tapped; /* bytes of an incomplete Modbus TCP frame; how many went to the tap */
    uint8_t frame[MD_MOST_TCP];
};

void md_line_init(struct md_line *line, int64_t now_ns);
/* Start an exchange; it ends immediately if a late reply could be mistaken for its reply. No byte is sent
 * before the line's silence is over. */
void md_line_begin(struct md_line *line, const struct md_exchange *exchange, struct md_completion *completion,
                   int64_t now_ns);
void md_line_put_back(struct md_line *line); /* undo md_line_begin() of a postponed exchange */
int md_line_want(struct md_line *line, int64_t now_ns); /* enum md_want */
int64_t md_line_silent_ns(const struct md_line *line);  /* end of the required silence */
/* Return how long after the line's last activity a read waits for a stalled adapter. Then the read is sent,
 * because the driver's count of unsent bytes may be wrong. `was_wrong`: the count was wrong before. */
int64_t md_line_hold_ns(const struct md_line *line, int was_wrong);
/* Record that the port took `len` bytes of the request between these two times. */
void md_line_sent(struct md_line *line, size_t len, int64_t begun_ns, int64_t now_ns);
void md_line_received(struct md_line *line, const uint8_t *bytes, size_t len, int64_t now_ns);
/* End the exchange in flight, because the port failed or the request must not be sent. */
void md_line_abandon(struct md_line *line, int result, int error);

/* ---- line.c: listening for another master ---- */

/* Start to listen for another master before the request is sent. Listen for the time of the longest frame
 * plus the drive's timeout, at least for the guard time. A network shows no other master's frames, so listen
 * there only for the guard time. Return 0 if no wait is needed. */
int md_listen_begin(struct md_line *line, int64_t now_ns, int64_t guard_ns);

/* ---- turn.c: the order of exchanges on a line; bytes and times are arguments ---- */

/* The source of an exchange. MD_AHEAD: the core itself sends a read before the wanted request. That read is a
 * proof (see late.c), or an echo probe, which shows whether the adapter echoes. */
enum md_source { MD_NO_SOURCE, MD_AHEAD, MD_URGENT, MD_QUEUED, MD_REPEATED };

struct md_slot {
    const struct md_exchange *exchange;
    int64_t not_before_ns;
};

/* An urgent request; it lives on the stack of its waiting caller. */
struct md_urgent {
    const struct md_exchange *exchange;
    int64_t not_before_ns; /* earliest time to send the request; 0: immediately */
    int64_t expires_ns;    /* latest time to send the request, by CLOCK_BOOTTIME; 0: no limit */
    struct md_completion *completion;
    struct md_urgent *next;
    int is_done;
};

/* The requests sent ahead of an exchange; all zero if there are none. */
struct md_before {
    const struct md_exchange *then; /* the exchange itself */
    uint64_t replies;               /* the drive's reply count before the last proof */
    uint32_t proofs, is_probed;     /* number of proofs sent; 1: the echo probe was sent */
    /* the drive's number of failures before the first request was sent ahead */
    uint32_t failures;
};

struct md_turn {
    int source, last;     /* enum md_source: of the exchange in flight, and of the previous one */
    int is_ending;        /* 1: start no more polled exchanges */
    int has_done_urgent;  /* an urgent exchange ended; the engine resets this flag */
    struct md_urgent *urgent;
    const struct md_exchange *const *round; /* the repeated exchanges */
    uint32_t round_len, round_at;
    struct md_slot *slots; /* a ring buffer */
    uint32_t room;         /* number of slots, a power of two */
    uint32_t is_idle;      /* 1: the thread may sleep, so md_port_submit() must wake it */
    int64_t owed_ns;       /* line time that polling must still get, because urgent requests took it */
    int64_t missed_ns;     /* time at which the latest exchange with a silent drive ended */
    int64_t miss_ns;       /* duration of that exchange; 0 after a read of a stop */
    struct md_before before;
    struct md_row_queue *row_queue;
    uint32_t number; /* the port's number in row_queue */
    struct md_progress progress; /* each counter is written by one thread; readers use atomics */
    struct md_line line;
    struct md_completion completion;
};

void md_turn_init(struct md_turn *turn, struct md_slot *slots, uint32_t room, int64_t now_ns);
/* See md_port_submit() and the other functions of ports. */
int md_turn_submit(struct md_turn *turn, const struct md_exchange *const *exchanges,
                   const int64_t *not_before_ns, int n);
uint32_t md_turn_repeat(struct md_turn *turn, const struct md_exchange *const *exchanges, uint32_t n);
void md_turn_add_urgent(struct md_turn *turn, struct md_urgent *urgent);
void md_turn_set_echo(struct md_turn *turn, int echo);
int md_turn_end(struct md_turn *turn);
int md_turn_is_asking(const struct md_turn *turn, const struct md_drive *drive);
int64_t md_turn_counted_ns(const struct md_turn *turn, int64_t now_ns);
/* Return the line's next action (enum md_want); MD_DONE: no exchange is due before wake_ns. */
int md_turn_want(struct md_turn *turn, int64_t *wake_ns, int64_t now_ns);
void md_turn_lose(struct md_turn *turn, int error); /* end all exchanges, because the port failed */
void md_turn_close(struct md_turn *turn);           /* end all exchanges, because the port closes */
/* cdef: end */

/* ---- line.c ---- */

/* Change the state by the table; ignore an event that cannot happen in this state. */
static inline void md_line_go(struct md_line *line, enum md_line_event event)
{
    int next = md_line_follows[line->state][event];
    if (next >= 0)
        line->state = next;
}

void md_listen_receive(struct md_line *line, size_t len, int64_t now_ns); /* bytes came while listening */

/* Return 1 if the exchange in flight waits for the end of listening. Stops do not wait. */
static inline int md_listen_is_held(const struct md_line *line)
{
    return line->listened_ns && line->state != MD_IDLE && !line->exchange->insists;
}

static inline int md_line_is_held(const struct md_line *line)
{
    return line->is_held && line->state == MD_READY;
}

/* Return 1 if the exchange is unsent because it waits for the end of listening, or for a stalled adapter.
 * An unsent exchange can go back to its queue, so that a stop is sent first. */
static inline int md_line_is_postponed(const struct md_line *line)
{
    return md_listen_is_held(line) || (md_line_is_held(line) && !line->exchange->insists);
}

/* The end of an exchange: its result, and the place of the completion's bytes in rx. */
struct md_ending {
    int result;
    size_t at, len;
};

/* Return 1 once part of the request has left. */
static inline int md_line_is_under_way(const struct md_line *line)
{
    return line->state >= MD_WRITING;
}

/* ---- reply.c: the reply among the bytes since the request ---- */

/* Start the wait for a reply of this length. */
void md_reply_await(struct md_line *line, int reply_len);
/* Search the received bytes for the reply; return 1 if the exchange ends. */
int md_reply_find(struct md_line *line, int64_t now_ns, struct md_ending *ending);
/* Set ready_ns to the earliest time at which the whole reply can have come. */
void md_reply_foresee(struct md_line *line, int64_t now_ns);
/* Return 1 if any bytes came besides the request's echo. */
int md_reply_has_begun(const struct md_line *line);
/* End the exchange at its timeout. */
struct md_ending md_reply_missed(struct md_line *line, int64_t now_ns);
/* Find late replies among stray bytes, from index `from` on. The search for the reply starts after them. */
void md_reply_find_late(struct md_line *line, size_t from, int64_t now_ns);

/* Return 1 if the reply at `at` ends the exchange; 0 if it was late and was removed from rx. */
int md_reply_judge(struct md_line *line, size_t at, int used, const struct md_message *reply, int64_t now_ns,
                   struct md_ending *ending);
void md_reply_accept(struct md_line *line, size_t at, int used, const struct md_message *reply);
/* Extend the timeout because a late reply came: the awaited reply may be as late. */
void md_reply_extend(struct md_line *line);
int md_reply_parse(const struct md_line *line, size_t at, struct md_message *reply);
/* Remove received bytes that belong to other exchanges. */
void md_reply_cut_out(struct md_line *line, size_t at, size_t len);

/* Return the transmission time of a frame on the drive's own wire, which may be behind a gateway. */
static inline int64_t md_wire_ns(const struct md_exchange *exchange, int64_t len)
{
    /* a Modbus TCP frame has six more bytes for the header, and two fewer for the CRC */
    enum { LONGER_THAN_RTU = 4 };
    return (exchange->framing == MD_TCP ? len - LONGER_THAN_RTU : len) * exchange->character_ns;
}

/* ---- tcp.c: Modbus TCP frames from a stream, and the matching of replies ---- */

/* Give the next request a new transaction id. */
void md_tcp_begin(struct md_line *line);
/* When a request is sent, note that a frame that is already partly received cannot be its reply. */
void md_tcp_disown(struct md_line *line);
/* Take bytes up to the end of a frame; return their number. */
size_t md_tcp_put(struct md_line *line, const uint8_t *bytes, size_t len, int64_t now_ns);
/* Process the frame if it is whole; return 1 if the exchange ends. */
int md_tcp_find(struct md_line *line, int64_t now_ns, struct md_ending *ending);
/* End the exchange at its timeout. */
struct md_ending md_tcp_missed(struct md_line *line);

/* ---- reply.c: adapters that echo ---- */

/* Return 1 if the adapter's copy of the request may still come. */
int md_echo_is_due(const struct md_line *line, int reply_len);
/* Return 1 if a copy of the request is at `at`. */
int md_echo_is_copy(const struct md_line *line, size_t at);
/* Return 1 if an echo probe must be sent before the exchange. */
int md_echo_is_in_doubt(const struct md_line *line);
/* Drop bytes that came while the request was sent, except the start of its echo. */
void md_echo_keep(struct md_line *line);

/* Return 1 if the reply is an exception, or if its one register is in least .. end - 1 (`end` 0: any). */
int md_is_in_range(const struct md_message *reply, uint16_t least, uint32_t end);
int md_is_read(int framing, uint8_t function);

/* Return 1 for a write other than a stop: such a request must not leave late. */
static inline int md_is_command(const struct md_exchange *exchange)
{
    return !exchange->insists && !md_is_read(exchange->framing, exchange->request.function);
}

int md_proof_is(const struct md_exchange *exchange);
/* If the ended exchange is a proof, record whether the drive answered it. */
void md_proof_end(const struct md_exchange *exchange, int result);

/* ---- late.c: replies after their timeout ---- */

/* Return the proof (a read, see late.c) to send before this exchange, so that no late reply can be mistaken
 * for the exchange's reply. NULL: no proof is needed, or none helps. */
const struct md_exchange *md_late_proof(const struct md_exchange *exchange, int64_t now_ns);
/* Return 1 if the reply may answer another process's request. */
int md_late_is_in_doubt(const struct md_exchange *exchange, const struct md_message *reply);
/* Return 1 if the exchange must not be sent now: a late reply could be mistaken for its reply. */
int md_late_bars(const struct md_exchange *exchange, int64_t now_ns);
/* Return 1 if the same request is outstanding: then a copy of the request may be a late reply, not an
 * echo. */
int md_late_is_repeated(const struct md_exchange *exchange);
/* Record that the ended exchange's reply may still come, in any order within the window. */
void md_late_expect(struct md_line *line, int64_t window_ns);
/* The drive's first reply may have been to another process's request. So record that the reply to this
 * process's request may still come. */
void md_late_doubt(struct md_line *line);
/* Add a drive with outstanding requests to the line's list of drives whose late replies may still come. */
void md_late_link(struct md_line *line, struct md_drive *drive);
/* Settle the earliest outstanding request that the reply at `at` fits. Return the reply's length,
 * MD_INCOMPLETE or MD_NO_START. If the reply also fits the exchange in flight, pass `since_ns`: it is set to
 * the time at which the same request was first sent, 0: it was not sent before. Otherwise pass NULL. */
int md_late_take(struct md_line *line, size_t at, int64_t now_ns, int64_t *since_ns);

/* ---- counters with one writer thread, and readers on other threads ---- */

static inline uint32_t md_load(const uint32_t *counter)
{
    return __atomic_load_n(counter, __ATOMIC_SEQ_CST);
}

static inline void md_store(uint32_t *counter, uint32_t value)
{
    __atomic_store_n(counter, value, __ATOMIC_SEQ_CST);
}

#endif
