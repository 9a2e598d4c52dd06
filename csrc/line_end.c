/* The end of an exchange: its bytes for the tap, its completion, and the counts of its drive and block. */
#include "line.h"

#include <string.h>

/* The drive does not answer, or cannot be reached. Damage says that it does. */
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
    case MD_NOT_MASTER:
    case MD_OTHER_MASTER:
        return 0;
    default:
        return result < 0;
    }
}

static void count_reply(struct md_block *block, uint8_t exception)
{
    if (exception) {
        block->refusals++;
        block->refusal = exception;
    } else if (block->refusals || !block->is_answered) { /* mostly nothing is written */
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
    int is_alive = completion->result == MD_BAD_ECHO && md_proof_is(exchange); /* its value is not as known */
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

void md_line_tap(const struct md_line *line, int side, int64_t time_ns, const uint8_t *bytes, size_t len)
{
    if (line->tap && md_line_is_under_way(line)) /* what came before was put there when it came */
        md_tap_put(line->tap, side, time_ns ? time_ns : line->completion->sent_ns, bytes, len);
}

/* What came since the request began to leave: the reply, or what came in its place, amid the rest. */
static void tap_received(const struct md_line *line, struct md_ending ending)
{
    const struct md_completion *completion = line->completion;
    size_t at = ending.at, len = ending.len;
    int may_be_echo = ending.result <= 0 && !line->transactions && line->tx_len > 0;
    if (may_be_echo && at == 0 && len >= line->tx_len && md_echo_is_copy(line, 0)) {
        at += line->tx_len; /* the adapter's echo */
        len -= line->tx_len;
    }
    md_line_tap(line, MD_NOISE, completion->first_ns, line->rx, at);
    md_line_tap(line, ending.result > 0 ? MD_ANSWERING : MD_FAILED, completion->first_ns, line->rx + at, len);
    md_line_tap(line, MD_NOISE, completion->last_ns, line->rx + at + len, line->rx_len - at - len);
    line->tap->ahead_ns = 0;
}

void md_line_complete(struct md_line *line, struct md_ending ending)
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
