/* One line as a state machine: silence, request, reply or timeout. It gets bytes and times as arguments, and
 * uses neither a descriptor nor a clock.
 *
 * On real lines junk, an echo, or another station's frame may come before the reply. Neither such bytes nor
 * a damaged frame end the exchange: the timeout keeps running (serial-line guide V1.02, 2.4.1). */
#include "line.h"

#include <errno.h>
#include <string.h>

/* ---- states ---- */

enum { IDLE = MD_IDLE, SILENCE, CHECK, READY, WRITING, AWAITING, LAST_LOOK, NONE = -1 };

const int8_t md_line_follows[MD_LINE_STATES][MD_LINE_EVENTS] = {
    /* Columns are events: MD_BEGUN, FELL_SILENT, NOTHING_CAME, STRAY_BYTES, PART_LEFT, ALL_LEFT, TIME_OUT,
     * BYTES_IN_TIME, ENDED. */
    [IDLE]      = { SILENCE, NONE,   NONE,   IDLE,    NONE,    NONE,     NONE,      NONE,     NONE },
    [SILENCE]   = { NONE,    CHECK,  NONE,   SILENCE, NONE,    NONE,     NONE,      NONE,     IDLE },
    [CHECK]     = { NONE,    NONE,   READY,  SILENCE, NONE,    NONE,     NONE,      NONE,     IDLE },
    [READY]     = { NONE,    NONE,   NONE,   SILENCE, WRITING, AWAITING, NONE,      NONE,     IDLE },
    [WRITING]   = { NONE,    NONE,   NONE,   WRITING, WRITING, AWAITING, NONE,      NONE,     IDLE },
    [AWAITING]  = { NONE,    NONE,   NONE,   NONE,    NONE,    NONE,     LAST_LOOK, AWAITING, IDLE },
    [LAST_LOOK] = { NONE,    NONE,   NONE,   NONE,    NONE,    NONE,     NONE,      AWAITING, IDLE },
};

/* ---- listening for another master ---- */

/* Before its first request a new master listens, because a line has only one master. Unexpected bytes are
 * another master's requests, or replies to them. They restart the wait, so that the first request leaves
 * after a long enough silence. The wait lasts at least for the guard time, in which the kernel's timer kills
 * a suspended former master. A network shows no other master's frames, so there only the guard time counts.
 *
 * A stop does not wait: the motor must stop, even beside another master. */

enum { LONGEST_RTU = 256 }; /* bytes of the longest RTU frame (serial-line guide V1.02, 2.5.1) */

/* The deadline allows one restart of the wait: a burst may be the last reply to a master that has left. */
int md_listen_begin(struct md_line *line, int64_t now_ns, int64_t guard_ns)
{
    const struct md_exchange *exchange = line->exchange;
    int longest = exchange->framing == MD_ASCII ? MD_MOST_FRAME : LONGEST_RTU;
    if (line->state != MD_READY || (line->transactions && !guard_ns))
        return 0;
    md_line_go(line, MD_STRAY_BYTES);
    int64_t listen_ns = longest * exchange->character_ns + exchange->drive->most_timeout_ns;
    line->listen_ns = line->transactions ? 0 : listen_ns;
    line->listened_ns = now_ns + later(line->listen_ns, guard_ns);
    line->give_up_ns = line->listened_ns + line->listen_ns;
    return 1;
}

void md_listen_receive(struct md_line *line, size_t len, int64_t now_ns)
{
    if (line->transactions) /* on a network, only replies to this process arrive */
        return;
    line->listened_ns = later(line->listened_ns, now_ns + line->listen_ns);
    line->foreign += (uint32_t)len;
}

static int end_listening(struct md_line *line, int64_t now_ns)
{
    if (!md_listen_is_held(line)) /* a stop is sent now, but later exchanges still listen */
        return 1;
    if (now_ns < line->listened_ns)
        return 0;
    line->listened_ns = 0;
    return 1;
}

/* ---- results of an exchange: bytes for the tap, the completion, counters of the drive and the block ---- */

/* Return 1 if the result shows that the drive is silent or unreachable. A damaged reply does not: the drive
 * did answer. */
static int is_failure(int result)
{
    static const uint8_t is_exempt[MD_STATUSES] = {
        [-MD_BAD_CHECKSUM] = 1, [-MD_BAD_CHARACTER] = 1, [-MD_LATE_ANSWER_DUE] = 1, [-MD_MAYBE_ECHO] = 1,
        [-MD_EXPIRED] = 1,      [-MD_LINE_LOST] = 1,     [-MD_POLL_ENDED] = 1,      [-MD_NOT_MASTER] = 1,
        [-MD_OTHER_MASTER] = 1, [-MD_STALLED] = 1,
    };
    return result < 0 && !is_exempt[-result];
}

static void count_reply(struct md_block *block, uint8_t exception)
{
    if (exception) {
        block->refusals++;
        block->refusal = exception;
    } else if (block->refusals || !block->is_answered) { /* write only if a field changes */
        block->refusals = 0;
        block->is_answered = 1;
    }
    if (block->failures)
        block->failures = 0;
}

static void count(const struct md_exchange *exchange, const struct md_completion *completion)
{
    struct md_drive *drive = exchange->drive;
    struct md_block *block = exchange->block;
    md_counters_end(exchange, completion);
    md_proof_end(exchange, completion->result);
    /* the drive replied, but with a value out of range */
    int is_alive = completion->result == MD_BAD_ECHO && md_proof_is(exchange);
    if (is_failure(completion->result)) {
        md_count_failures(drive, is_alive ? 0 : drive->failures + 1);
        if (block)
            block->failures++;
    }
    if (completion->result <= 0)
        return;
    md_count_failures(drive, 0);
    if (block)
        count_reply(block, completion->reply.exception);
}

static void tap_bytes(const struct md_line *line, int side, int64_t time_ns, const uint8_t *bytes, size_t len)
{
    if (line->tap && md_line_is_under_way(line)) /* bytes before the request already went to the tap */
        md_tap_put(line->tap, side, time_ns ? time_ns : line->completion->sent_ns, bytes, len);
}

/* Copy to the tap all bytes that came since the request was sent: the good or bad reply, and, as noise, the
 * bytes before and after the reply. */
static void tap_received(const struct md_line *line, struct md_ending ending)
{
    const struct md_completion *completion = line->completion;
    size_t at = ending.at, len = ending.len;
    int may_be_echo = ending.result <= 0 && !line->transactions && line->tx_len > 0;
    if (may_be_echo && at == 0 && len >= line->tx_len && md_echo_is_copy(line, 0)) {
        at += line->tx_len; /* the adapter's echo */
        len -= line->tx_len;
    }
    tap_bytes(line, MD_NOISE, completion->first_ns, line->rx, at);
    tap_bytes(line, ending.result > 0 ? MD_ANSWERING : MD_FAILED, completion->first_ns, line->rx + at, len);
    tap_bytes(line, MD_NOISE, completion->last_ns, line->rx + at + len, line->rx_len - at - len);
    line->tap->ahead_ns = 0;
}

static void complete(struct md_line *line, struct md_ending ending)
{
    struct md_completion *completion = line->completion;
    if (line->tap)
        tap_received(line, ending);
    size_t most = sizeof completion->raw, cut = ending.len > most ? ending.len - most : 0;
    completion->result = ending.result;
    completion->raw_len = (uint16_t)(ending.len - cut);
    memcpy(completion->raw, line->rx + ending.at + cut, completion->raw_len);
    count(line->exchange, completion);
}

/* ---- the end of an exchange ---- */

static const int64_t WORTH_WAITING = 250000; /* ns; a shorter sleep costs more than reading the port */

/* Return the silence in ns that is required before and after an exchange; 0 on a network. But if a gateway's
 * replies do not have their requests' ids, a silence separates the exchanges: a second copy of a reply could
 * be mistaken for the next reply. */
static int64_t silence_of(const struct md_line *line, const struct md_exchange *exchange)
{
    enum { CHARACTERS = 4 };
    int64_t least_ns = line->transactions == MD_IGNORED ? CHARACTERS * exchange->character_ns : 0;
    return later(least_ns, exchange->silence_ns);
}

/* Return 1 if the reply must be to the last request: no earlier request to the drive lacks its reply, and no
 * other bytes came before the request. */
static int is_surely_answered(const struct md_line *line, int result)
{
    const struct md_drive *drive = line->exchange->drive;
    if (result <= 0 || drive->owed_count || line->completion->stale)
        return 0;
    return drive->proof_count || drive->counters.sent == drive->counters.answered;
}

static void finish(struct md_line *line, struct md_ending ending)
{
    const struct md_completion *completion = line->completion;
    complete(line, ending);
    line->rx_len = line->rx_from = 0;
    line->quiet_ns = later(line->quiet_ns, completion->last_ns);
    if (line->transactions && completion->last_ns) /* a network needs no silence */
        line->quiet_ns = completion->last_ns;
    if (completion->sent_ns) { /* otherwise the previous exchange's silence is still required */
        line->silence_ns = silence_of(line, line->exchange);
        line->is_answered = (uint8_t)is_surely_answered(line, ending.result);
    }
    md_line_go(line, MD_ENDED);
}

/* End the exchange with this failure; the completion gets all bytes received. */
static void fail(struct md_line *line, int result)
{
    finish(line, (struct md_ending){result, 0, line->rx_len});
}

void md_line_abandon(struct md_line *line, int result, int error)
{
    if (line->state == MD_IDLE)
        return;
    if (line->state >= MD_AWAITING && line->transactions != MD_MATCHED)
        md_late_expect(line, md_window_ns(line->exchange)); /* the reply may come on the reopened port */
    line->completion->error = error;
    fail(line, result);
}

/* ---- the request ---- */

void md_line_init(struct md_line *line, int64_t now_ns)
{
    *line = (struct md_line){.state = MD_IDLE, .quiet_ns = now_ns, .transaction = (uint16_t)(now_ns >> 16)};
}

/* Set tx to the request's bytes; a short frame is stored in the exchange. Return 0, or an enum
 * md_frame_fault. */
static int load(struct md_line *line, const struct md_exchange *exchange)
{
    int is_tcp = exchange->framing == MD_TCP;
    if (is_tcp != (line->transactions != MD_NO_TRANSACTIONS))
        return MD_BAD_REQUEST; /* the framing does not fit the port */
    line->tx = exchange->frame;
    line->tx_len = exchange->frame_len;
    if (line->tx_len && !is_tcp)
        return 0;
    int length = md_build_request(exchange->framing, &exchange->request, line->long_tx, sizeof line->long_tx);
    if (length < 0)
        return length;
    line->tx = line->long_tx;
    line->tx_len = (uint16_t)length;
    if (is_tcp)
        md_tcp_begin(line);
    return 0;
}

void md_line_begin(struct md_line *line, const struct md_exchange *exchange, struct md_completion *completion,
                   int64_t now_ns)
{
    /* reply.data and raw are read only up to their lengths, so they are not cleared. */
    memset(completion, 0, offsetof(struct md_completion, reply.data));
    completion->begun_ns = now_ns;
    completion->stale = line->rx_len;
    line->exchange = exchange;
    line->completion = completion;
    line->tx_at = 0;
    line->is_held = 0;
    line->silence_ns = later(line->silence_ns, silence_of(line, exchange));
    line->give_up_ns = later(now_ns, md_line_silent_ns(line)) + exchange->drive->most_timeout_ns;
    md_line_go(line, MD_BEGUN);
    if (md_listen_is_held(line))
        line->give_up_ns = later(line->give_up_ns, line->listened_ns + exchange->drive->most_timeout_ns);
    if (exchange->drive->owed_count) /* requests sent on another line, or before this port was reopened */
        md_late_link(line, exchange->drive);
    int refused = md_late_bars(exchange, now_ns) ? MD_LATE_ANSWER_DUE : load(line, exchange);
    if (refused)
        finish(line, (struct md_ending){refused, 0, 0});
}

void md_line_put_back(struct md_line *line)
{
    md_line_go(line, MD_ENDED);
}

int64_t md_line_silent_ns(const struct md_line *line)
{
    return line->quiet_ns + line->silence_ns;
}

/* Hold a read of a silent drive for longer than others: in that time another drive's reply can show that the
 * driver's count of unsent bytes is wrong. A silent drive cannot show that. */
int64_t md_line_hold_ns(const struct md_line *line, int was_wrong)
{
    enum { WRONG_S = 1, SECONDS = 30, SILENT_S = 40 };
    if (was_wrong)
        return WRONG_S * MD_SECOND_NS;
    return (line->exchange->drive->failures ? SILENT_S : SECONDS) * MD_SECOND_NS;
}

static int64_t free_ns(const struct md_line *line)
{
    int64_t silent_ns = md_line_silent_ns(line);
    return md_listen_is_held(line) ? later(silent_ns, line->listened_ns) : silent_ns;
}

int md_line_want(struct md_line *line, int64_t now_ns)
{
    switch (line->state) {
    case MD_SILENCE: /* if bytes keep coming, wait until give_up_ns only */
        line->wake_ns = sooner(free_ns(line), line->give_up_ns);
        if (now_ns < line->wake_ns)
            return md_listen_is_held(line) ? MD_READ : MD_WAIT;
        md_line_go(line, MD_FELL_SILENT);
        return MD_READ;
    case MD_CHECK:
        if (line->listened_ns && !end_listening(line, now_ns)) {
            fail(line, MD_OTHER_MASTER);
            return MD_DONE;
        }
        md_line_go(line, MD_NOTHING_CAME);
        line->rx_len = line->rx_from = 0;
        line->wake_ns =
            now_ns + line->exchange->drive->most_timeout_ns + md_wire_ns(line->exchange, line->tx_len);
        return MD_WRITE;
    case MD_READY:
    case MD_WRITING: /* a port that takes no bytes until wake_ns is broken */
        if (now_ns < line->wake_ns)
            return MD_WRITE;
        md_line_abandon(line, md_line_is_held(line) ? MD_STALLED : MD_LINE_LOST, ETIMEDOUT);
        return MD_DONE;
    case MD_AWAITING:
        if (line->ready_ns - now_ns > WORTH_WAITING && line->ready_ns < line->give_up_ns) {
            line->wake_ns = line->ready_ns;
            line->waited = 1;
            return MD_WAIT;
        }
        line->wake_ns = md_reply_has_begun(line) ? line->give_up_ns : line->begun_by_ns;
        if (line->looks++ && line->rx_len < line->tx_len)
            line->missing_ns = line->looked_ns;
        line->looked_ns = now_ns;
        if (now_ns >= line->wake_ns) /* the reply may be waiting in the driver: read once more */
            md_line_go(line, MD_TIME_OUT);
        else if (now_ns < line->copy_by_ns)
            line->wake_ns = sooner(line->wake_ns, line->copy_by_ns);
        return MD_READ;
    case MD_LAST_LOOK:
        finish(line, line->transactions ? md_tcp_missed(line) : md_reply_missed(line, now_ns));
        return MD_DONE;
    default:
        return MD_DONE;
    }
}

void md_line_sent(struct md_line *line, size_t len, int64_t begun_ns, int64_t now_ns)
{
    const struct md_exchange *exchange = line->exchange;
    if (len == 0 || (line->state != MD_READY && line->state != MD_WRITING))
        return;
    if (line->tx_at == 0) {
        line->completion->sent_ns = begun_ns;
        line->rx_len = line->rx_from = 0;
        md_tcp_disown(line);
    }
    if (line->tap)
        line->tap->ahead_ns = line->completion->utc_ahead_ns;
    md_tap_put(line->tap, MD_ASKING, begun_ns, line->tx + line->tx_at, len);
    line->quiet_ns = later(line->quiet_ns, now_ns) + md_wire_ns(exchange, (int64_t)len);
    line->tx_at = (uint16_t)(line->tx_at + len);
    md_line_go(line, line->tx_at < line->tx_len ? MD_PART_LEFT : MD_ALL_LEFT);
    if (line->state == MD_WRITING)
        return;
    md_echo_keep(line);
    int reply_len = md_reply_length(exchange->framing, &exchange->request);
    if (reply_len > 0) {
        line->echo_due = (uint8_t)md_echo_is_due(line, reply_len);
        md_reply_await(line, reply_len);
        return;
    }
    finish(line, (struct md_ending){0, 0, 0});
    line->silence_ns = later(exchange->silence_ns, exchange->turnaround_ns);
}

/* ---- received bytes ---- */

/* Make room by discarding the older half of rx: a reply that started there would be complete by now. */
static void forget(struct md_line *line)
{
    enum { GONE = sizeof line->rx / 2 };
    _Static_assert(sizeof line->rx / 2 >= MD_MOST_FRAME, "half of the room holds the longest frame");
    if (md_line_is_under_way(line)) /* before the request, there is no completion yet */
        tap_bytes(line, MD_NOISE, line->completion->first_ns, line->rx, GONE);
    line->sight = 0;
    line->rx_len = (uint16_t)(line->rx_len - GONE);
    line->rx_from = (uint16_t)(line->rx_from > GONE ? line->rx_from - GONE : 0);
    memmove(line->rx, line->rx + GONE, line->rx_len);
}

/* Store as many bytes as fit, and return how many. */
static size_t keep(struct md_line *line, const uint8_t *bytes, size_t len)
{
    if (line->rx_len == sizeof line->rx)
        forget(line);
    size_t room = sizeof line->rx - line->rx_len, taken = len < room ? len : room;
    memcpy(line->rx + line->rx_len, bytes, taken);
    line->rx_len = (uint16_t)(line->rx_len + taken);
    return taken;
}

/* Process stray bytes. They delay the next request, which needs a silent line. */
static void take_stray(struct md_line *line, const uint8_t *bytes, size_t len, int64_t now_ns)
{
    line->quiet_ns = later(line->quiet_ns, now_ns); /* quiet_ns is in the future while a request is leaving */
    if (line->listened_ns)
        md_listen_receive(line, len, now_ns);
    if (line->state != MD_IDLE)
        line->completion->stale += (uint32_t)len;
    if (!md_line_is_under_way(line))
        md_tap_put(line->tap, MD_NOISE, now_ns, bytes, len);
    if (line->state == MD_IDLE || now_ns < line->give_up_ns)
        md_line_go(line, MD_STRAY_BYTES);
    for (size_t at = 0; at < len;)
        at += keep(line, bytes + at, len - at);
    md_reply_find_late(line, line->rx_from, now_ns);
}

/* Process Modbus TCP frames. If replies have their requests' ids, other frames do not delay a request. */
static void take_frames(struct md_line *line, const uint8_t *bytes, size_t len, int64_t now_ns)
{
    struct md_ending ending;
    if (line->state < MD_AWAITING && line->transactions == MD_IGNORED) {
        line->quiet_ns = later(line->quiet_ns, now_ns);
        if (line->state == MD_IDLE || now_ns < line->give_up_ns)
            md_line_go(line, MD_STRAY_BYTES);
    }
    while (len > 0 && !line->is_out_of_step) {
        if (line->state >= MD_AWAITING) {
            line->completion->last_ns = now_ns;
            if (line->completion->first_ns == 0)
                line->completion->first_ns = now_ns;
        }
        size_t taken = md_tcp_put(line, bytes, len, now_ns);
        bytes += taken;
        len -= taken;
        if (md_tcp_find(line, now_ns, &ending))
            finish(line, ending);
    }
    if (line->state < MD_AWAITING) /* no reply is awaited, and the bytes are not Modbus TCP */
        md_tap_put(line->tap, MD_NOISE, now_ns, bytes, len);
    /* for the error message, keep bytes that are not Modbus TCP */
    for (size_t at = 0; at < len && line->state >= MD_AWAITING;)
        at += keep(line, bytes + at, len - at);
    if (line->state != MD_IDLE && now_ns < line->give_up_ns)
        md_line_go(line, MD_BYTES_IN_TIME);
}

void md_line_received(struct md_line *line, const uint8_t *bytes, size_t len, int64_t now_ns)
{
    struct md_completion *completion = line->completion;
    struct md_ending ending;
    if (len == 0)
        return;
    if (line->transactions) {
        take_frames(line, bytes, len, now_ns);
        return;
    }
    if (line->state < MD_AWAITING) {
        take_stray(line, bytes, len, now_ns);
        return;
    }
    if (completion->first_ns == 0)
        completion->first_ns = now_ns;
    completion->last_ns = now_ns;
    completion->skipped += (uint32_t)len;
    size_t at = 0;
    while (at < len && line->state != MD_IDLE) {
        at += keep(line, bytes + at, len - at);
        if (md_reply_find(line, now_ns, &ending))
            finish(line, ending);
    }
    if (at < len) /* the exchange has ended, and these bytes came after the reply */
        md_tap_put(line->tap, MD_NOISE, now_ns, bytes + at, len - at);
    if (line->state != MD_IDLE && now_ns < line->give_up_ns)
        md_line_go(line, MD_BYTES_IN_TIME);
    if (line->state == MD_AWAITING)
        md_reply_foresee(line, now_ns);
}
