/* One line as a state machine: silence, request, reply or time-out. It knows neither descriptor
 * nor clock: bytes and time come in as arguments.
 *
 * The expected reply may begin anywhere in what was received, because driver turn-on junk, local
 * echo and other stations' frames come first on real lines. Neither they nor a damaged frame end
 * the exchange: the time-out keeps running (serial-line guide V1.02, 2.4.1). Whether the adapter
 * echoes what it sends shows in the replies that are no copies of their requests. */
#include "multidrop.h"

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

/* How much a reason says about what went wrong. The one that says most is reported, and of several
 * that say as much the first: a frame from another address may hold our own further on. */
static int weight(int reason)
{
    static const uint8_t weights[] = {
        [-MD_NO_START] = 1,
        [-MD_BAD_ADDRESS] = 2,
        [-MD_BAD_FUNCTION] = 2,
        [-MD_BAD_LENGTH] = 3,
        [-MD_BAD_CHARACTER] = 4,
        [-MD_CUT_SHORT] = 5,
        [-MD_BAD_CHECKSUM] = 6,
        [-MD_BAD_ECHO] = 7,
    };
    return reason < 0 && (size_t)-reason < sizeof weights ? weights[-reason] : 0;
}

static int64_t later(int64_t a, int64_t b)
{
    return a > b ? a : b;
}

static void finish(struct md_line *line, int result, const uint8_t *raw, size_t raw_len)
{
    struct md_completion *completion = line->completion;
    if (raw_len > sizeof completion->raw) {
        raw += raw_len - sizeof completion->raw;
        raw_len = sizeof completion->raw;
    }
    completion->result = result;
    completion->raw_len = (uint16_t)raw_len;
    memcpy(completion->raw, raw, raw_len);
    line->quiet_ns = later(line->quiet_ns, completion->last_ns);
    if (completion->sent_ns) /* else what went before it still has its say */
        line->silence_ns = line->exchange->silence_ns;
    line->state = IDLE;
}

static int parse_at(const struct md_line *line, size_t at, struct md_message *reply)
{
    return md_parse_reply(line->exchange->framing, line->rx + at, line->rx_len - at, &line->exchange->request, reply);
}

static int is_copy(const struct md_line *line, size_t at)
{
    return at + line->tx_len <= line->rx_len && memcmp(line->rx + at, line->tx, line->tx_len) == 0;
}

static void time_out(struct md_line *line)
{
    struct md_message reply;
    size_t begin = is_copy(line, 0) ? line->tx_len : 0; /* the adapter's echo says nothing */
    int reason = begin == line->rx_len ? MD_NO_REPLY : MD_INCOMPLETE;
    for (size_t at = begin; at < line->rx_len; at++) {
        int why = parse_at(line, at, &reply);
        if (why == MD_INCOMPLETE)
            why = MD_CUT_SHORT;
        if (weight(why) > weight(reason))
            reason = why;
    }
    finish(line, reason, line->rx, line->rx_len);
}

/* A reply that is no copy of the request tells whether a copy goes before replies on this line. */
static void learn_echo(struct md_line *line, size_t reply_at)
{
    if (is_copy(line, reply_at))
        return;
    if (line->completion->skipped == 0)
        line->echoes = 0;
    for (size_t at = 0; at + line->tx_len <= reply_at; at++)
        if (is_copy(line, at))
            line->echoes = 1;
}

/* Look for the reply at every place where it may still begin. */
static void search(struct md_line *line)
{
    struct md_message reply;
    size_t first_open = line->rx_len;
    for (size_t at = line->rx_from; at < line->rx_len; at++) {
        int used = parse_at(line, at, &reply);
        if (used > 0 && line->echo_due && is_copy(line, at)) {
            line->echo_due = 0; /* the adapter's, not the drive's */
            used = MD_NO_START;
            first_open = line->rx_len;
            at += line->tx_len - 1u;
        }
        if (used > 0) {
            line->completion->reply = reply;
            line->completion->skipped -= (uint32_t)used;
            learn_echo(line, at);
            finish(line, used, line->rx + at, (size_t)used);
            return;
        }
        if (used == MD_INCOMPLETE && at < first_open)
            first_open = at;
    }
    line->rx_from = (uint16_t)first_open;
}

/* Make room: the older half goes. No reply can have begun there and not be whole by now. */
static void forget(struct md_line *line)
{
    enum { GONE = sizeof line->rx / 2 };
    _Static_assert(sizeof line->rx / 2 >= MD_MOST_FRAME, "half of the room holds the longest frame");
    line->rx_len = (uint16_t)(line->rx_len - GONE);
    line->rx_from = (uint16_t)(line->rx_from - GONE);
    memmove(line->rx, line->rx + GONE, line->rx_len);
}

void md_line_init(struct md_line *line, int64_t now_ns)
{
    *line = (struct md_line){.state = IDLE, .quiet_ns = now_ns};
}

void md_line_begin(struct md_line *line, const struct md_exchange *exchange,
                   struct md_completion *completion, int64_t now_ns)
{
    *completion = (struct md_completion){.begun_ns = now_ns};
    line->exchange = exchange;
    line->completion = completion;
    line->tx_at = line->rx_len = line->rx_from = 0;
    line->echo_due = line->echoes;
    line->silence_ns = later(line->silence_ns, exchange->silence_ns);
    line->give_up_ns = later(now_ns, line->quiet_ns + line->silence_ns) + exchange->timeout_ns;
    line->state = SILENT;
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
        if (now_ns >= line->wake_ns)
            line->state = LOOKING;
        return MD_READ;
    case LOOKING:
        line->state = SENDING;
        line->wake_ns = now_ns + line->exchange->timeout_ns + line->tx_len * line->exchange->character_ns;
        return MD_WRITE;
    case SENDING: /* a port that takes nothing is a broken port */
        if (now_ns < line->wake_ns)
            return MD_WRITE;
        md_line_lost(line, MD_LINE_LOST, ETIMEDOUT);
        return MD_DONE;
    case LISTENING:
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

void md_line_sent(struct md_line *line, size_t len, int64_t now_ns)
{
    const struct md_exchange *exchange = line->exchange;
    if (line->state != SENDING || len == 0)
        return;
    if (line->tx_at == 0)
        line->completion->sent_ns = now_ns;
    line->quiet_ns = later(line->quiet_ns, now_ns) + (int64_t)len * exchange->character_ns;
    line->tx_at = (uint16_t)(line->tx_at + len);
    if (line->tx_at < line->tx_len)
        return;
    int reply_len = md_reply_length(exchange->framing, &exchange->request);
    if (reply_len == 0) {
        finish(line, 0, line->rx, 0);
        line->silence_ns = later(exchange->silence_ns, exchange->turnaround_ns);
        return;
    }
    line->wake_ns = line->quiet_ns + exchange->timeout_ns + reply_len * exchange->character_ns;
    line->state = LISTENING;
}

void md_line_received(struct md_line *line, const uint8_t *bytes, size_t len, int64_t now_ns)
{
    struct md_completion *completion = line->completion;
    if (len == 0)
        return;
    if (line->state == SILENT || line->state == LOOKING) {
        completion->stale += (uint32_t)len;
        line->quiet_ns = now_ns;
        if (now_ns < line->give_up_ns)
            line->state = SILENT;
        return;
    }
    if (line->state != LISTENING && line->state != ENDING)
        return;
    if (completion->first_ns == 0)
        completion->first_ns = now_ns;
    completion->last_ns = now_ns;
    completion->skipped += (uint32_t)len;
    while (len > 0 && line->state != IDLE) {
        if (line->rx_len == sizeof line->rx)
            forget(line);
        size_t room = sizeof line->rx - line->rx_len, taken = len < room ? len : room;
        memcpy(line->rx + line->rx_len, bytes, taken);
        line->rx_len = (uint16_t)(line->rx_len + taken);
        bytes += taken;
        len -= taken;
        search(line);
    }
}

void md_line_lost(struct md_line *line, int result, int error)
{
    if (line->state == IDLE)
        return;
    line->completion->error = error;
    finish(line, result, line->rx, line->rx_len);
}
