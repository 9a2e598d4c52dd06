/* Choose when to read the port after a request, find the reply among the bytes that came, and learn from it
 * about the drive and the adapter.
 *
 * The reply may start at any byte. Late replies may precede or replace it. frame.c and body.c check the
 * reply against its request. */
#include "line.h"

#include <string.h>

/* ---- adapters that echo ---- */

/* Some adapters echo the bytes that they send. A reply that differs from its request shows whether the
 * adapter echoes. So does a timeout if only a copy of the request came. While it is unknown whether the
 * adapter echoes, a copy of the request does not count as the reply. body.c checks that the reply to a write
 * repeats the address and the value. */

enum { MOST_LONE_COPIES = 2 }; /* copies accepted as replies before the next echo probe */

/* Even an adapter that is known not to echo may start to echo at any time. Then the echo of a read could be
 * mistaken for its reply if both have the same length. The echo of a write does no harm: the library also
 * reads the register back. */
int md_echo_is_due(const struct md_line *line, int reply_len)
{
    const struct md_exchange *exchange = line->exchange;
    int may_be_copied =
        reply_len == line->tx_len && md_is_read(exchange->framing, exchange->request.function);
    return !line->transactions && (line->echo != MD_NO_ECHO || may_be_copied);
}

int md_echo_is_copy(const struct md_line *line, size_t at)
{
    return at + line->tx_len <= line->rx_len && memcmp(line->rx + at, line->tx, line->tx_len) == 0;
}

/* Return 1 if all bytes from `at` on are the start of a copy of the request. */
static int may_become_copy(const struct md_line *line, size_t at)
{
    size_t len = line->rx_len - at;
    return len < line->tx_len && memcmp(line->rx + at, line->tx, len) == 0;
}

static void learn(struct md_line *line, int echo)
{
    if (!line->echo_is_configured)
        line->echo = (uint8_t)echo;
}

/* Return the time by which an echo of the request in flight would be whole. Return 0 unless the line is known
 * not to echo and the drive's delay is known well enough. */
static int64_t echo_whole_ns(const struct md_line *line)
{
    int64_t due_ns = line->echo == MD_NO_ECHO ? md_reply_due_ns(line->exchange) : 0;
    return due_ns ? line->quiet_ns + due_ns : 0;
}

/* Return 1 if the copy of the request is the reply: it was still incomplete when an echo would have been
 * complete. */
static int is_timely_copy(const struct md_line *line)
{
    return line->copy_by_ns && line->missing_ns >= line->copy_by_ns;
}

/* Learn from a reply whether the adapter echoes. A copy of the request before the reply is an echo. But if
 * the reply itself equals the request, and the adapter is known not to echo, the reply may have come twice.
 * Without a copy, the adapter does not echo. A few stray bytes before the reply do not change that, unless
 * the adapter is known to echo: then they may be the rest of an echo. */
static void learn_echo(struct md_line *line, size_t reply_at)
{
    int is_copy = md_echo_is_copy(line, reply_at);
    int shown = is_copy && line->echo == MD_NO_ECHO ? MD_ECHO_UNKNOWN : MD_ECHO;
    uint32_t most_stray = line->echo == MD_ECHO_UNKNOWN ? (line->tx_len - 1U) / 2 : 0;
    if (line->completion->skipped - line->cut <= most_stray && !is_copy)
        learn(line, line->echo == MD_ECHO ? MD_ECHO_UNKNOWN : MD_NO_ECHO); /* the echo may have been lost */
    for (size_t at = 0; at + line->tx_len <= reply_at && !md_late_is_repeated(line->exchange); at++)
        if (md_echo_is_copy(line, at))
            learn(line, shown);
    if (!is_copy || is_timely_copy(line))
        line->lone_copies = 0;
}

enum copy { IS_ECHO, MAY_BE_REPLY, IS_REPLY };

/* Classify a copy of the request without other bytes: it is the adapter's echo, or the drive's reply if the
 * reply may equal the request. */
static enum copy learn_lone_copy(struct md_line *line, int may_be_reply)
{
    if (!may_be_reply || line->echo == MD_ECHO) {
        learn(line, MD_ECHO);
        return IS_ECHO;
    }
    if (line->echo == MD_ECHO_UNKNOWN)
        return MAY_BE_REPLY;
    if (line->lone_copies < MOST_LONE_COPIES)
        line->lone_copies++;
    return IS_REPLY;
}

/* An adapter may have started to echo: then a drive that seems to answer with copies may be dead. */
int md_echo_is_in_doubt(const struct md_line *line)
{
    return line->echo == MD_ECHO_UNKNOWN || line->lone_copies == MOST_LONE_COPIES;
}

void md_echo_keep(struct md_line *line)
{
    if (line->rx_len > line->tx_len || memcmp(line->rx, line->tx, line->rx_len) != 0) {
        md_tap_put(line->tap, MD_NOISE, line->completion->sent_ns, line->rx, line->rx_len);
        line->rx_len = line->rx_from = 0;
    }
    line->completion->stale -= line->rx_len;
    line->completion->skipped = line->rx_len;
}

/* ---- replies ---- */

enum { MOST_BURST = 16 }; /* limit of the characters that a UART collects before it delivers them */
/* ns; if the request may be older than this, no row is made */
static const int64_t OLDEST_IN_DOUBT = INT64_C(2000000000);

int md_reply_parse(const struct md_line *line, size_t at, struct md_message *reply)
{
    const struct md_exchange *exchange = line->exchange;
    int used = md_parse_reply(exchange->framing, line->rx + at, line->rx_len - at, &exchange->request, reply);
    return used > 0 && !md_is_in_range(reply, exchange->least, exchange->end) ? MD_BAD_ECHO : used;
}

/* ---- when to read ---- */

void md_reply_await(struct md_line *line, int reply_len)
{
    const struct md_exchange *exchange = line->exchange;
    const struct md_drive *drive = exchange->drive;
    int64_t reply_ns = md_wire_ns(exchange, reply_len), timeout_ns = md_timeout_ns(exchange);
    int longest = md_longest_reply(exchange->framing, &exchange->request);
    line->give_up_ns = line->quiet_ns + timeout_ns + md_wire_ns(exchange, longest);
    line->ready_ns = 0;
    line->begun_by_ns = line->give_up_ns;
    if (line->burst > 0 && drive->delay_ns) /* otherwise the adapter may deliver whole replies */
        line->ready_ns = line->quiet_ns + md_look_ns(exchange) + reply_ns;
    if (line->burst > 0 && drive->failures == 0) {
        int64_t begun_ns = timeout_ns + (line->burst + 2) * exchange->character_ns;
        line->begun_by_ns = sooner(line->quiet_ns + begun_ns, line->begun_by_ns);
        if (line->begun_by_ns + begun_ns < line->ready_ns) /* an early read costs less than a late one */
            line->ready_ns = line->begun_by_ns;
    }
    line->missing_ns = 0;
    line->copy_by_ns = line->echo_due ? echo_whole_ns(line) : 0;
    line->waited = 0;
    line->looks = 0;
    line->sight = 0;
    line->cut = 0;
}

int md_reply_has_begun(const struct md_line *line)
{
    return line->rx_len > 0 && !(line->rx_len == line->tx_len && md_echo_is_copy(line, 0));
}

/* A reply comes character by character: wait for several characters before each read. Do not wait if the
 * reply may be an exception, which is shorter. In the text of an ASCII frame an exception's function starts
 * with '8' or a later digit. */
void md_reply_foresee(struct md_line *line, int64_t now_ns)
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
    int may_be_exception =
        have <= function_at || (begun[function_at] & MD_EXCEPTION_BIT) || begun[function_at] >= '8';
    if (missing > 1 && !(may_be_exception && have > 0))
        line->ready_ns = now_ns + (missing - 1) * exchange->character_ns;
}

void md_reply_extend(struct md_line *line)
{
    const struct md_exchange *exchange = line->exchange;
    int64_t reply_ns = md_wire_ns(exchange, md_longest_reply(exchange->framing, &exchange->request));
    line->give_up_ns = later(line->give_up_ns, line->quiet_ns + md_timeout_ns(exchange) + reply_ns);
    line->begun_by_ns = line->give_up_ns;
}

/* ---- a reply ---- */

/* Record the drive's response delay and the time that the exchange took on the line. */
static void measure(struct md_line *line, int reply_len)
{
    const struct md_exchange *exchange = line->exchange;
    struct md_completion *completion = line->completion;
    struct md_drive *drive = exchange->drive;
    int64_t request_ns = md_wire_ns(exchange, line->tx_len), reply_ns = md_wire_ns(exchange, reply_len);
    int64_t left_ns = line->quiet_ns, begun_ns = completion->last_ns - reply_ns;
    /* Compute the first character's time from the last one's: that is more exact than the time of a late
     * read. This calculation fails on ports that are faster than their settings, such as pseudo-terminals,
     * because all their bytes may come together. */
    line->is_quicker |= begun_ns < left_ns;
    if (!line->is_quicker)
        completion->first_ns =
            sooner(completion->first_ns, later(begun_ns + exchange->character_ns, left_ns));
    int is_whole = line->waited && line->looks == 1;
    int64_t delay_ns = md_learn_delay(exchange, later(begun_ns - left_ns, 0), is_whole);
    int64_t ideal_ns = line->silence_ns + request_ns + delay_ns + reply_ns;
    /* On a port that is faster than its settings, such as a network's, count at most the time that the
     * exchange took. */
    int64_t ended_ns = line->transactions ? completion->last_ns : later(completion->last_ns, left_ns);
    int64_t took_ns = line->silence_ns + ended_ns - completion->sent_ns;
    md_counters_answer(drive, delay_ns, sooner(ideal_ns, took_ns));
}

/* If the first read found only part of the reply, the adapter delivers bursts, not whole replies. */
static void learn_burst(struct md_line *line, size_t at, int reply_len)
{
    if (line->sight_at == at && line->sight < reply_len && line->sight <= MOST_BURST &&
        line->sight > line->burst)
        line->burst = line->sight;
}

static void note_answer(const struct md_line *line, struct md_drive *drive)
{
    if (drive->answered_ns && line->quiet_ns - drive->answered_ns >= MD_PAUSE_S * MD_SECOND_NS)
        drive->history->pauses++;
    drive->answered_ns = line->quiet_ns;
}

void md_reply_accept(struct md_line *line, size_t at, int used, const struct md_message *reply)
{
    if (!line->exchange->insists)
        note_answer(line, line->exchange->drive);
    md_copy_message(&line->completion->reply, reply);
    line->completion->skipped -= (uint32_t)used;
    line->is_proven = 1;
    if (!line->transactions) {
        learn_echo(line, at);
        learn_burst(line, at, used);
    }
    measure(line, used);
}

/* ---- late replies ---- */

void md_reply_cut_out(struct md_line *line, size_t at, size_t len)
{
    md_tap_put(line->tap, MD_NOISE, line->completion->last_ns, line->rx + at, len);
    line->cut += (uint32_t)len;
    line->sight = 0;
    line->rx_len = (uint16_t)(line->rx_len - len);
    memmove(line->rx + at, line->rx + at + len, line->rx_len - at);
}

void md_reply_find_late(struct md_line *line, size_t from, int64_t now_ns)
{
    for (size_t at = from; line->late && at < line->rx_len; at++) {
        int used = md_late_take(line, at, now_ns, NULL);
        if (used > 0) {
            at += (size_t)used - 1;
            line->rx_from = (uint16_t)(at + 1); /* count this late reply only once */
        }
    }
}

/* End the exchange with a reply that answers either its request or an earlier one; a second reply may still
 * come. If the earlier request was the same, a row can hold the value, with an uncertainty that covers both
 * requests. A client that waits needs the present value, so the value is read again. */
static struct md_ending end_in_doubt(struct md_line *line, size_t at, int used,
                                     const struct md_message *reply, int64_t now_ns, int64_t since_ns)
{
    struct md_completion *completion = line->completion;
    const struct md_block *block = line->exchange->block;
    int64_t request_ns = md_wire_ns(line->exchange, line->tx_len);
    int is_row = since_ns && block && block->count > 0 && now_ns - since_ns < OLDEST_IN_DOUBT;
    md_late_expect(line, 0);
    if (!is_row) {
        md_reply_find_late(line, at + (size_t)used, now_ns);
        return (struct md_ending){MD_LATE_ANSWER_DUE, 0, line->rx_len};
    }
    md_copy_message(&completion->reply, reply);
    completion->skipped -= (uint32_t)used;
    completion->sent_ns = since_ns - request_ns;
    md_counters_answer(line->exchange->drive, 0, request_ns + md_wire_ns(line->exchange, used));
    return (struct md_ending){used, at, (size_t)used};
}

/* The first reply may be to another process's request: end the exchange so that it is sent again. The reply
 * still shows whether the adapter echoes. */
static struct md_ending doubt_first(struct md_line *line, size_t at, int used, int64_t now_ns)
{
    line->completion->skipped -= (uint32_t)used;
    if (!line->transactions)
        learn_echo(line, at);
    md_late_doubt(line);
    md_reply_find_late(line, at + (size_t)used, now_ns);
    return (struct md_ending){MD_LATE_ANSWER_DUE, 0, line->rx_len};
}

/* ---- the search ---- */

int md_reply_judge(struct md_line *line, size_t at, int used, const struct md_message *reply, int64_t now_ns,
                   struct md_ending *ending)
{
    const struct md_exchange *exchange = line->exchange;
    int64_t since_ns;
    if (md_late_is_in_doubt(exchange, reply)) {
        *ending = doubt_first(line, at, used, now_ns);
        return 1;
    }
    int is_late = !exchange->insists && exchange->drive->owed_count &&
                  md_late_take(line, at, now_ns, &since_ns) > 0;
    if (!is_late) {
        md_reply_accept(line, at, used, reply);
        *ending = (struct md_ending){used, at, (size_t)used};
        return 1;
    }
    /* The reply came at least this long after its request, whichever request it answers. */
    md_learn_lateness(exchange->drive, now_ns - line->quiet_ns, 0);
    md_reply_extend(line);
    if (md_is_read(exchange->framing, exchange->request.function)) {
        *ending = end_in_doubt(line, at, used, reply, now_ns, since_ns);
        return 1;
    }
    md_reply_cut_out(line, at, (size_t)used);
    return 0;
}

/* Find another master's read request before a reply to a read: the reply probably answers that request.
 * Return the request's index; SIZE_MAX: none. */
static size_t find_foreign_read(const struct md_line *line, size_t reply_at)
{
    const struct md_exchange *exchange = line->exchange;
    const struct md_message *own = &exchange->request;
    struct md_message request;
    if (exchange->framing == MD_DELIXI || !md_is_read(exchange->framing, own->function))
        return SIZE_MAX; /* Delixi's replies look like requests */
    for (size_t at = 0; at < reply_at; at++) {
        int used = md_parse_request(exchange->framing, line->rx + at, reply_at - at, &request);
        if (used > 0 && request.address == own->address && request.function == own->function &&
            !md_echo_is_copy(line, at))
            return at;
    }
    return SIZE_MAX;
}

/* Try each byte as the start of the reply. Search for late replies only while no earlier byte may start the
 * reply: later bytes may be inside it. */
int md_reply_find(struct md_line *line, int64_t now_ns, struct md_ending *ending)
{
    struct md_message reply;
    size_t at = line->rx_from, first_open = SIZE_MAX;
    while (at < line->rx_len) {
        int used = md_reply_parse(line, at, &reply);
        if (used > 0 && line->echo_due && may_become_copy(line, at))
            used = MD_INCOMPLETE;
        if (used > 0 && line->echo_due && md_echo_is_copy(line, at) && !is_timely_copy(line)) {
            line->echo_due = 0; /* this copy is the adapter's echo, or looks the same */
            at += line->tx_len;
            first_open = SIZE_MAX;
            continue;
        }
        size_t foreign_at = used > 0 ? find_foreign_read(line, at) : SIZE_MAX;
        if (foreign_at != SIZE_MAX) {
            md_reply_cut_out(line, foreign_at, at + (size_t)used - foreign_at);
            at = foreign_at;
            first_open = first_open < at ? first_open : SIZE_MAX;
            continue;
        }
        if (used > 0 && md_reply_judge(line, at, used, &reply, now_ns, ending))
            return 1;
        if (used > 0) /* a late reply was cut out there */
            continue;
        if (used != MD_INCOMPLETE && first_open == SIZE_MAX)
            used = md_late_take(line, at, now_ns, NULL);
        if (used > 0) {
            md_reply_extend(line);
            md_reply_cut_out(line, at, (size_t)used);
            continue;
        }
        if (used == MD_INCOMPLETE && first_open == SIZE_MAX)
            first_open = at;
        at++;
    }
    line->rx_from = first_open < line->rx_len ? (uint16_t)first_open : line->rx_len;
    return 0;
}

/* ---- no reply ---- */

/* Return 1 if the bytes start with a damaged frame of the drive: then the drive has answered. Foreign frames,
 * echo and noise do not count. Later bytes are not checked, because they may be inside another frame. */
static int is_damaged_answer(const struct md_line *line, size_t begin, int found)
{
    if (begin == 0 && line->echo == MD_ECHO)
        return 0;
    if (found == MD_BAD_CHARACTER) /* the parser finds this fault before it checks the address */
        return line->rx_len >= begin + 5 &&
               md_hex_byte(line->rx + begin + 1) == line->exchange->request.address &&
               md_hex_byte(line->rx + begin + 3) >= 0;
    return found == MD_BAD_CHECKSUM;
}

struct md_ending md_reply_missed(struct md_line *line, int64_t now_ns)
{
    const struct md_exchange *exchange = line->exchange;
    struct md_message reply;
    struct md_ending ending;
    size_t begin = md_echo_is_copy(line, 0) ? line->tx_len : 0; /* skip the echo */
    int is_doubtful = 0;
    if (line->rx_len == 0)
        line->lone_copies = 0;
    if (begin > 0 && begin == line->rx_len) {
        int used = md_reply_parse(line, 0, &reply);
        enum copy copy = learn_lone_copy(line, used > 0);
        if (copy == IS_REPLY && md_reply_judge(line, 0, used, &reply, now_ns, &ending))
            return ending;
        is_doubtful = copy == MAY_BE_REPLY;
    }
    int first = begin == line->rx_len ? MD_NO_REPLY : md_reply_parse(line, begin, &reply);
    /* If other requests are outstanding, the damaged frame may be the reply to such a request. */
    if (exchange->drive->owed_count || !is_damaged_answer(line, begin, first))
        md_late_expect(line, md_window_ns(exchange));
    if (!is_doubtful)
        md_learn_silence(exchange->drive);
    int reason = md_reason(exchange->framing, &exchange->request, line->rx + begin, line->rx_len - begin);
    if (first == MD_BAD_ECHO) /* a good frame with a value out of range, which md_reason() does not check */
        reason = first;
    return (struct md_ending){is_doubtful ? MD_MAYBE_ECHO : reason, 0, line->rx_len};
}
