/* Adapters that repeat what they send. A reply that is no copy of its request tells whether the adapter
 * does, and so does a copy that is all that comes before a time-out. Until that is known, no copy is taken
 * for the reply. That a drive's reply echoes the written address and value is checked in body.c. */
#include "line.h"

#include <string.h>

enum { MOST_LONE_COPIES = 2 }; /* taken for replies before an echo probe is sent again */

/* An adapter may begin to echo at any time. A write whose confirmation is a copy is read back; a read that
 * may be answered by a copy waits for the reply behind it. */
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

int md_echo_may_follow(const struct md_line *line, size_t at)
{
    size_t len = line->rx_len - at;
    return len < line->tx_len && memcmp(line->rx + at, line->tx, len) == 0;
}

static void learn(struct md_line *line, int echo)
{
    if (!line->echo_is_told)
        line->echo = (uint8_t)echo;
}

/* A copy that goes before replies shows on this line, and so do two copies, unless there was no echo so far:
 * then the reply may have come twice. A few stray bytes are no echo, but what is left of one where there is
 * known to be one. */
void md_echo_learn(struct md_line *line, size_t reply_at)
{
    int is_copy = md_echo_is_copy(line, reply_at);
    int shown = is_copy && line->echo == MD_NO_ECHO ? MD_ECHO_UNKNOWN : MD_ECHO;
    uint32_t most_stray = line->echo == MD_ECHO_UNKNOWN ? (line->tx_len - 1U) / 2 : 0;
    if (line->completion->skipped - line->cut <= most_stray && !is_copy)
        learn(line, line->echo == MD_ECHO ? MD_ECHO_UNKNOWN : MD_NO_ECHO); /* one may have been lost */
    for (size_t at = 0; at + line->tx_len <= reply_at && !md_late_is_repeated(line->exchange); at++)
        if (md_echo_is_copy(line, at))
            learn(line, shown);
    if (!is_copy)
        line->lone_copies = 0;
}

/* Only an adapter repeats the request and sends no more, or the drive itself where a copy is its reply. */
enum md_copy md_echo_learn_alone(struct md_line *line, int may_be_reply)
{
    if (!may_be_reply || line->echo == MD_ECHO) {
        learn(line, MD_ECHO);
        return MD_COPY_IS_ECHO;
    }
    if (line->echo == MD_ECHO_UNKNOWN)
        return MD_COPY_MAY_BE_REPLY;
    if (line->lone_copies < MOST_LONE_COPIES)
        line->lone_copies++;
    return MD_COPY_IS_REPLY;
}

/* Where it was known not to echo, it may echo now, and the drive that seems to answer be dead. */
int md_echo_is_in_doubt(const struct md_line *line)
{
    return line->echo == MD_ECHO_UNKNOWN || line->lone_copies == MOST_LONE_COPIES;
}

void md_echo_learn_silence(struct md_line *line)
{
    line->lone_copies = 0;
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
