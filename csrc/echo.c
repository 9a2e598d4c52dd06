/* Adapters that repeat what they send. A reply that is no copy of its request tells whether the adapter
 * does, and so does a copy that is all that comes before a time-out. Until that is known, no copy is taken
 * for the reply. That a drive's reply echoes the written address and value is checked in body.c. */
#include "line.h"

#include <string.h>

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

/* A copy that goes before replies shows on this line, and so do two copies. A few stray bytes are no echo,
 * but what is left of one where there is known to be one. */
void md_echo_learn(struct md_line *line, size_t reply_at)
{
    uint32_t most_stray = line->echo == MD_ECHO_UNKNOWN ? (line->tx_len - 1U) / 2 : 0;
    if (line->completion->skipped - line->cut <= most_stray && !md_echo_is_copy(line, reply_at))
        learn(line, line->echo == MD_ECHO ? MD_ECHO_UNKNOWN : MD_NO_ECHO); /* one may have been lost */
    for (size_t at = 0; at + line->tx_len <= reply_at && !md_late_is_repeated(line->exchange); at++)
        if (md_echo_is_copy(line, at))
            learn(line, MD_ECHO);
}

/* Only an adapter repeats the request and sends no more, or the drive itself where a copy is its reply. */
int md_echo_learn_alone(struct md_line *line, int is_reply)
{
    int is_doubtful = is_reply && line->echo == MD_ECHO_UNKNOWN;
    if (!is_doubtful)
        learn(line, MD_ECHO);
    return is_doubtful;
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
