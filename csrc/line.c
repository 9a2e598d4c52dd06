/* One line as a state machine: silence, request, reply or time-out. It knows neither descriptor
 * nor clock: bytes and time come in as arguments.
 *
 * The expected reply may begin anywhere in what was received, because driver turn-on junk, local
 * echo and other stations' frames come first on real lines. Neither they nor a damaged frame end
 * the exchange: the time-out keeps running (serial-line guide V1.02, 2.4.1). Whether the adapter
 * echoes what it sends shows in the replies that are no copies of their requests, and where a copy
 * is all that comes before a time-out; until it does, no copy is taken for the reply. */
#include "internal.h"

#include <errno.h>
#include <string.h>

enum state {
    IDLE,
    SILENT,    /* waits until the line has been silent for long enough */
    LOOKING,   /* looks for bytes that came meanwhile, once, before it sends */
    SENDING,
    LISTENING,
    ENDING     /* the time-out is over: looks once more, because it may be late to look at all */
};

static const int64_t OLDEST_IN_DOUBT = INT64_C(2000000000); /* of a row's value */
static const int64_t WORTH_WAITING = 250000; /* ns; before a shorter time a sleep costs more than a look */

enum { MOST_BURST = 16 }; /* characters that a UART gathers before it hands them over */

/* Whether this says that the drive does not answer, or cannot be reached. Damage says that it does. */
static int is_failure(int result)
{
    switch (result) {
    case MD_BAD_CHECKSUM:
    case MD_BAD_CHARACTER:
    case MD_LATE_ANSWER_DUE:
    case MD_MAYBE_ECHO:
    case MD_EXPIRED:
    case MD_LINE_LOST:
    case MD_POLL_ENDED:
        return 0;
    default:
        return result < 0;
    }
}

static void count(const struct md_exchange *exchange, const struct md_completion *completion)
{
    struct md_drive *drive = exchange->drive;
    md_counters_end(&drive->counters, exchange, completion);
    if (is_failure(completion->result))
        md_count_failures(drive, drive->failures + 1);
    if (completion->result > 0)
        md_count_failures(drive, 0);
}

static void count_refusals(struct md_block *block, const struct md_completion *completion)
{
    if (!block || completion->result <= 0)
        return;
    if (completion->reply.exception) {
        block->refusals++;
        block->refusal = completion->reply.exception;
    } else if (block->refusals) {
        block->refusals = 0;
    }
}

static int is_copy(const struct md_line *line, size_t at)
{
    return at + line->tx_len <= line->rx_len && memcmp(line->rx + at, line->tx, line->tx_len) == 0;
}

/* Whether all that there is begins as the request does, and there is less of it. */
static int may_become_copy(const struct md_line *line, size_t at)
{
    size_t len = line->rx_len - at;
    return len < line->tx_len && memcmp(line->rx + at, line->tx, len) == 0;
}

/* Whether a part of the request at least has left. */
static int is_under_way(const struct md_line *line)
{
    return line->state > SENDING || (line->state == SENDING && line->tx_at > 0);
}

static void tell(const struct md_line *line, int side, int64_t time_ns, const uint8_t *bytes, size_t len)
{
    if (is_under_way(line)) /* what came before was told when it came */
        md_tap_put(line->tap, side, time_ns ? time_ns : line->completion->sent_ns, bytes, len);
}

/* What came since the request began to leave: the reply, or what came in its place, amid the rest. */
static void tell_received(const struct md_line *line, int result, const uint8_t *raw, size_t raw_len)
{
    if (result <= 0 && is_copy(line, 0) && raw == line->rx && raw_len >= line->tx_len) {
        raw += line->tx_len; /* the adapter's echo */
        raw_len -= line->tx_len;
    }
    const struct md_completion *completion = line->completion;
    size_t at = (size_t)(raw - line->rx);
    tell(line, MD_NOISE, completion->first_ns, line->rx, at);
    tell(line, result > 0 ? MD_ANSWERING : MD_FAILED, completion->first_ns, raw, raw_len);
    tell(line, MD_NOISE, completion->last_ns, raw + raw_len, line->rx_len - at - raw_len);
}

static void finish(struct md_line *line, int result, const uint8_t *raw, size_t raw_len)
{
    struct md_completion *completion = line->completion;
    tell_received(line, result, raw, raw_len);
    if (raw_len > sizeof completion->raw) {
        raw += raw_len - sizeof completion->raw;
        raw_len = sizeof completion->raw;
    }
    completion->result = result;
    completion->raw_len = (uint16_t)raw_len;
    memcpy(completion->raw, raw, raw_len);
    line->rx_len = line->rx_from = 0;
    line->quiet_ns = later(line->quiet_ns, completion->last_ns);
    if (completion->sent_ns) /* else what went before it still has its say */
        line->silence_ns = line->exchange->silence_ns;
    line->state = IDLE;
    count(line->exchange, completion);
    count_refusals(line->exchange->block, completion);
}

/* The reply is there: what it says of the drive's own delay, and what it had to take of the line. */
static void measure(struct md_line *line, int reply_len)
{
    const struct md_exchange *exchange = line->exchange;
    struct md_completion *completion = line->completion;
    int64_t request_ns = line->tx_len * exchange->character_ns, reply_ns = reply_len * exchange->character_ns;
    int64_t left_ns = line->quiet_ns, begun_ns = completion->last_ns - reply_ns;
    /* Characters that follow each other tell better when the first came than a late look at them. */
    int64_t first_ns = later(begun_ns + exchange->character_ns, left_ns);
    if (first_ns < completion->first_ns)
        completion->first_ns = first_ns;
    int64_t delay_ns = later(begun_ns - left_ns, 0);
    struct md_drive *drive = exchange->drive;
    int is_whole = line->waited && line->looks == 1;
    delay_ns = md_learn_delay(drive, delay_ns, is_whole, exchange->character_ns);
    int64_t ideal_ns = line->silence_ns + request_ns + delay_ns + reply_ns;
    /* A port that is faster than its settings, such as a network's, needs no more than it took. */
    int64_t took_ns = line->silence_ns + later(completion->last_ns, left_ns) - completion->sent_ns;
    md_counters_answer(&drive->counters, delay_ns, ideal_ns < took_ns ? ideal_ns : took_ns);
}

static int parse_at(const struct md_line *line, size_t at, struct md_message *reply)
{
    const struct md_exchange *exchange = line->exchange;
    int used = md_parse_reply(exchange->framing, line->rx + at, line->rx_len - at, &exchange->request, reply);
    return used > 0 && !md_is_in_range(reply, exchange->least, exchange->most) ? MD_BAD_ECHO : used;
}

/* Among bytes that came unasked, or behind a late answer. */
static void recognise_late_answers(struct md_line *line, size_t from, int64_t now_ns)
{
    for (size_t at = from; line->late && at < line->rx_len; at++) {
        int used = md_late_take(line, at, now_ns, NULL);
        if (used > 0)
            at += (size_t)used - 1;
    }
}

/* Whether this, at the beginning of what came, says that the drive has answered. Only a damaged frame of its
 * own does: others', the echo and noise do not, and what looks like one further on may be the inside of another. */
static int is_damaged_answer(const struct md_line *line, size_t begin, int found)
{
    if (begin == 0 && line->echo == MD_ECHO)
        return 0;
    if (found == MD_BAD_CHARACTER) /* of which the framing looks at no address */
        return line->rx_len >= begin + 5 && md_hex_byte(line->rx + begin + 1) == line->exchange->request.address &&
               md_hex_byte(line->rx + begin + 3) >= 0;
    return found == MD_BAD_CHECKSUM;
}

static void learn(struct md_line *line, int echo)
{
    if (!line->echo_is_told)
        line->echo = echo;
}

static void time_out(struct md_line *line)
{
    const struct md_exchange *exchange = line->exchange;
    struct md_message reply;
    size_t begin = is_copy(line, 0) ? line->tx_len : 0; /* the adapter's echo says nothing */
    int is_alone = begin > 0 && begin == line->rx_len;
    int is_doubtful = is_alone && line->echo == MD_ECHO_UNKNOWN && parse_at(line, 0, &reply) > 0;
    if (is_alone && !is_doubtful)
        learn(line, MD_ECHO); /* nobody else says it again and no more */
    int first = begin == line->rx_len ? MD_NO_REPLY : parse_at(line, begin, &reply);
    if (exchange->drive->owed_count || !is_damaged_answer(line, begin, first)) /* it may be an earlier one's */
        md_late_expect(line, md_window_ns(exchange));
    if (!is_doubtful)
        md_learn_silence(exchange->drive);
    int reason = md_reason(exchange->framing, &exchange->request, line->rx + begin, line->rx_len - begin);
    finish(line, is_doubtful ? MD_MAYBE_ECHO : reason, line->rx, line->rx_len);
}

/* A reply that is no copy of the request tells whether a copy goes before replies on this line; so do
 * two copies. A few stray bytes are no echo, but what is left of one where there is known to be one. */
static void learn_echo(struct md_line *line, size_t reply_at)
{
    uint32_t most_stray = line->echo == MD_ECHO_UNKNOWN ? (line->tx_len - 1U) / 2 : 0;
    if (line->completion->skipped - line->cut <= most_stray && !is_copy(line, reply_at))
        learn(line, line->echo == MD_ECHO ? MD_ECHO_UNKNOWN : MD_NO_ECHO); /* one may have been lost */
    for (size_t at = 0; at + line->tx_len <= reply_at && !md_late_is_repeated(line->exchange); at++)
        if (is_copy(line, at))
            learn(line, MD_ECHO);
}

/* A reply of which little was seen first tells that the adapter does not keep it until it is whole. */
static void learn_burst(struct md_line *line, size_t at, int reply_len)
{
    if (line->sight_at == at && line->sight < reply_len && line->sight <= MOST_BURST && line->sight > line->burst)
        line->burst = line->sight;
}

/* Anything came, but at most the request's echo. */
static int has_begun(const struct md_line *line)
{
    return line->rx_len > 0 && !(line->rx_len == line->tx_len && is_copy(line, 0));
}

/* What is no part of this exchange, as far as anyone can tell from the rest. */
static void cut_out(struct md_line *line, size_t at, size_t len)
{
    tell(line, MD_NOISE, line->completion->last_ns, line->rx + at, len);
    line->cut += (uint32_t)len;
    line->sight = 0;
    line->rx_len = (uint16_t)(line->rx_len - len);
    memmove(line->rx + at, line->rx + at + len, line->rx_len - at);
}

/* A late answer came meanwhile: the reply may be as late. */
static void extend(struct md_line *line)
{
    const struct md_exchange *exchange = line->exchange;
    int64_t reply_ns = md_reply_length(exchange->framing, &exchange->request) * exchange->character_ns;
    line->give_up_ns = later(line->give_up_ns, line->quiet_ns + md_timeout_ns(exchange) + reply_ns);
    line->begun_by_ns = line->give_up_ns;
}

/* It answers this question or an earlier one, and the other's answer may still come. A row may have it, with
 * a time that leaves that open; whoever asks for a value by hand wants the present one: another question
 * tells more. */
static void end_in_doubt(struct md_line *line, size_t at, int used, const struct md_message *reply, int64_t now_ns,
                         int64_t since_ns)
{
    struct md_completion *completion = line->completion;
    const struct md_block *block = line->exchange->block;
    int64_t request_ns = line->tx_len * line->exchange->character_ns;
    int is_row = since_ns && block && block->count > 0 && now_ns - since_ns < OLDEST_IN_DOUBT;
    md_late_expect(line, 0);
    if (!is_row) {
        recognise_late_answers(line, at + (size_t)used, now_ns);
        finish(line, MD_LATE_ANSWER_DUE, line->rx, line->rx_len);
        return;
    }
    md_copy_message(&completion->reply, reply);
    completion->skipped -= (uint32_t)used;
    completion->sent_ns = since_ns - request_ns;
    md_counters_answer(&line->exchange->drive->counters, 0, request_ns + used * line->exchange->character_ns);
    finish(line, used, line->rx + at, (size_t)used);
}

/* Look for the reply at every place where it may still begin. A late answer is looked for only where
 * what precedes it cannot be the reply's beginning: it may be the inside of the reply. */
static void search(struct md_line *line, int64_t now_ns)
{
    const struct md_exchange *exchange = line->exchange;
    struct md_drive *drive = exchange->drive;
    struct md_message reply;
    size_t at = line->rx_from, first_open = SIZE_MAX;
    int64_t since_ns;
    while (at < line->rx_len) {
        int used = parse_at(line, at, &reply);
        if (used > 0 && line->echo_due && may_become_copy(line, at))
            used = MD_INCOMPLETE;
        if (used > 0 && line->echo_due && is_copy(line, at)) {
            line->echo_due = 0; /* the adapter's, or it cannot be told from that */
            first_open = SIZE_MAX;
            at += line->tx_len;
            continue;
        }
        if (used > 0 && !exchange->insists && drive->owed_count && md_late_take(line, at, now_ns, &since_ns) > 0) {
            md_learn_lateness(drive, now_ns - line->quiet_ns, 0); /* whichever it answers, it took as long as that */
            extend(line);
            if (md_is_read(exchange->framing, exchange->request.function)) {
                end_in_doubt(line, at, used, &reply, now_ns, since_ns);
                return;
            }
            cut_out(line, at, (size_t)used);
            continue;
        }
        if (used > 0) {
            if (!exchange->insists)
                drive->answered_ns = line->quiet_ns;
            md_copy_message(&line->completion->reply, &reply);
            line->completion->skipped -= (uint32_t)used;
            learn_echo(line, at);
            learn_burst(line, at, used);
            measure(line, used);
            finish(line, used, line->rx + at, (size_t)used);
            return;
        }
        if (used != MD_INCOMPLETE && first_open == SIZE_MAX)
            used = md_late_take(line, at, now_ns, NULL);
        if (used > 0) {
            extend(line);
            cut_out(line, at, (size_t)used);
            continue;
        }
        if (used == MD_INCOMPLETE && first_open == SIZE_MAX)
            first_open = at;
        at++;
    }
    line->rx_from = first_open < line->rx_len ? (uint16_t)first_open : line->rx_len;
}

/* A reply that has begun comes character by character: it is not worth looking at each. */
static void foresee(struct md_line *line, int64_t now_ns)
{
    const struct md_exchange *exchange = line->exchange;
    const uint8_t *begun = line->rx + line->rx_from;
    int have = line->rx_len - line->rx_from;
    if (have > 0 && (line->sight == 0 || line->sight_at != line->rx_from)) {
        line->sight_at = line->rx_from;
        line->sight = (uint16_t)have;
    }
    int function_at = exchange->framing == MD_RTU ? 1 : 3;
    int missing = md_reply_length(exchange->framing, &exchange->request) - have;
    int may_be_exception = have <= function_at || (begun[function_at] & 0x80) || begun[function_at] >= '8';
    if (missing > 1 && !(may_be_exception && have > 0))
        line->ready_ns = now_ns + (missing - 1) * exchange->character_ns;
}

/* Make room: the older half goes. No reply can have begun there and not be whole by now. */
static void forget(struct md_line *line)
{
    enum { GONE = sizeof line->rx / 2 };
    _Static_assert(sizeof line->rx / 2 >= MD_MOST_FRAME, "half of the room holds the longest frame");
    if (is_under_way(line)) /* else there is no completion, or its owner has it back */
        tell(line, MD_NOISE, line->completion->first_ns, line->rx, GONE);
    line->sight = 0;
    line->rx_len = (uint16_t)(line->rx_len - GONE);
    line->rx_from = (uint16_t)(line->rx_from > GONE ? line->rx_from - GONE : 0);
    memmove(line->rx, line->rx + GONE, line->rx_len);
}

void md_line_init(struct md_line *line, int64_t now_ns)
{
    *line = (struct md_line){.state = IDLE, .quiet_ns = now_ns};
}

void md_line_begin(struct md_line *line, const struct md_exchange *exchange,
                   struct md_completion *completion, int64_t now_ns)
{
    memset(completion, 0, offsetof(struct md_completion, reply.data)); /* what follows counts by its length */
    completion->begun_ns = now_ns;
    completion->stale = line->rx_len;
    line->exchange = exchange;
    line->completion = completion;
    line->tx_at = 0;
    line->echo_due = line->echo != MD_NO_ECHO;
    line->silence_ns = later(line->silence_ns, exchange->silence_ns);
    line->give_up_ns = later(now_ns, line->quiet_ns + line->silence_ns) + exchange->drive->most_timeout_ns;
    line->state = SILENT;
    md_late_resume(line, exchange->drive);
    if (md_late_bars(exchange, now_ns)) {
        finish(line, MD_LATE_ANSWER_DUE, line->rx, 0);
        return;
    }
    int length = md_build_request(exchange->framing, &exchange->request, line->tx, sizeof line->tx);
    if (length < 0)
        finish(line, length, line->rx, 0);
    else
        line->tx_len = (uint16_t)length;
}

int md_line_want(struct md_line *line, int64_t now_ns)
{
    switch (line->state) {
    case SILENT:
        line->wake_ns = line->quiet_ns + line->silence_ns;
        if (line->wake_ns > line->give_up_ns)
            line->wake_ns = line->give_up_ns;
        if (now_ns < line->wake_ns)
            return MD_WAIT;
        line->state = LOOKING;
        return MD_READ;
    case LOOKING:
        line->state = SENDING;
        line->rx_len = line->rx_from = 0;
        line->wake_ns = now_ns + line->exchange->drive->most_timeout_ns + line->tx_len * line->exchange->character_ns;
        return MD_WRITE;
    case SENDING: /* a port that takes nothing is a broken port */
        if (now_ns < line->wake_ns)
            return MD_WRITE;
        md_line_abandon(line, MD_LINE_LOST, ETIMEDOUT);
        return MD_DONE;
    case LISTENING:
        if (line->ready_ns - now_ns > WORTH_WAITING && line->ready_ns < line->give_up_ns) {
            line->wake_ns = line->ready_ns;
            line->waited = 1;
            return MD_WAIT;
        }
        line->wake_ns = has_begun(line) ? line->give_up_ns : line->begun_by_ns;
        line->looks++;
        if (now_ns >= line->wake_ns)
            line->state = ENDING;
        return MD_READ;
    case ENDING:
        time_out(line);
        return MD_DONE;
    default:
        return MD_DONE;
    }
}

/* What came while the request was leaving answers nothing, but may be the beginning of its echo. */
static void keep_echo(struct md_line *line)
{
    if (line->rx_len > line->tx_len || memcmp(line->rx, line->tx, line->rx_len) != 0) {
        tell(line, MD_NOISE, line->completion->sent_ns, line->rx, line->rx_len);
        line->rx_len = 0;
    }
    line->completion->stale -= line->rx_len;
    line->completion->skipped = line->rx_len;
}

void md_line_sent(struct md_line *line, size_t len, int64_t begun_ns, int64_t now_ns)
{
    const struct md_exchange *exchange = line->exchange;
    if (line->state != SENDING || len == 0)
        return;
    if (line->tx_at == 0) {
        line->completion->sent_ns = begun_ns;
        line->rx_len = 0;
    }
    md_tap_put(line->tap, MD_ASKING, begun_ns, line->tx + line->tx_at, len);
    line->quiet_ns = later(line->quiet_ns, now_ns) + (int64_t)len * exchange->character_ns;
    line->tx_at = (uint16_t)(line->tx_at + len);
    if (line->tx_at < line->tx_len)
        return;
    keep_echo(line);
    int reply_len = md_reply_length(exchange->framing, &exchange->request);
    if (reply_len == 0) {
        finish(line, 0, line->rx, 0);
        line->silence_ns = later(exchange->silence_ns, exchange->turnaround_ns);
        return;
    }
    int64_t reply_ns = reply_len * exchange->character_ns;
    const struct md_drive *drive = exchange->drive;
    line->give_up_ns = line->quiet_ns + md_timeout_ns(exchange) + reply_ns;
    line->ready_ns = 0;
    line->begun_by_ns = line->give_up_ns;
    if (line->burst > 0 && drive->delay_ns) /* what comes at once is there when the port is ready */
        line->ready_ns = line->quiet_ns + md_look_ns(drive, exchange->character_ns) + reply_ns;
    if (line->burst > 0 && drive->failures == 0) {
        int64_t begun_ns = md_timeout_ns(exchange) + (line->burst + 2) * exchange->character_ns;
        if (line->quiet_ns + begun_ns < line->begun_by_ns)
            line->begun_by_ns = line->quiet_ns + begun_ns;
        if (line->begun_by_ns + begun_ns < line->ready_ns) /* a look is cheaper than so long a wait in vain */
            line->ready_ns = line->begun_by_ns;
    }
    line->waited = line->looks = line->sight = 0;
    line->cut = 0;
    line->state = LISTENING;
}

/* Take in as much as there is room for; how much. */
static size_t keep(struct md_line *line, const uint8_t *bytes, size_t len)
{
    if (line->rx_len == sizeof line->rx)
        forget(line);
    size_t room = sizeof line->rx - line->rx_len, taken = len < room ? len : room;
    memcpy(line->rx + line->rx_len, bytes, taken);
    line->rx_len = (uint16_t)(line->rx_len + taken);
    return taken;
}

/* Bytes that nobody asked for: they put off the next request, which must find the line silent. */
static void take_stale(struct md_line *line, const uint8_t *bytes, size_t len, int64_t now_ns)
{
    line->quiet_ns = later(line->quiet_ns, now_ns); /* the request before may still be leaving */
    if (line->state != IDLE)
        line->completion->stale += (uint32_t)len;
    if (!is_under_way(line))
        md_tap_put(line->tap, MD_NOISE, now_ns, bytes, len);
    int is_unsent = line->state == LOOKING || (line->state == SENDING && line->tx_at == 0);
    if (is_unsent && now_ns < line->give_up_ns)
        line->state = SILENT;
    for (size_t at = 0; at < len;)
        at += keep(line, bytes + at, len - at);
    recognise_late_answers(line, 0, now_ns);
}

void md_line_received(struct md_line *line, const uint8_t *bytes, size_t len, int64_t now_ns)
{
    struct md_completion *completion = line->completion;
    if (len == 0)
        return;
    if (line->state != LISTENING && line->state != ENDING) {
        take_stale(line, bytes, len, now_ns);
        return;
    }
    if (completion->first_ns == 0)
        completion->first_ns = now_ns;
    completion->last_ns = now_ns;
    completion->skipped += (uint32_t)len;
    size_t at = 0;
    while (at < len && line->state != IDLE) {
        at += keep(line, bytes + at, len - at);
        search(line, now_ns);
    }
    if (at < len) /* behind the reply, and there was no room for it beside what came before that */
        md_tap_put(line->tap, MD_NOISE, now_ns, bytes + at, len - at);
    if (line->state == ENDING && now_ns < line->give_up_ns)
        line->state = LISTENING;
    if (line->state == LISTENING)
        foresee(line, now_ns);
}

void md_line_abandon(struct md_line *line, int result, int error)
{
    if (line->state == IDLE)
        return;
    if (line->state > SENDING)
        md_late_expect(line, md_window_ns(line->exchange)); /* the port may be back before it comes */
    line->completion->error = error;
    finish(line, result, line->rx, line->rx_len);
}
