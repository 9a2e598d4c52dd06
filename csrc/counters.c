/* What became of a drive's exchanges, counted in memory that does not grow.
 *
 * Numbers only rise, so that a span of time is the difference of two looks. Response delays fall into
 * buckets, PARTS of them to each doubling. */
#include "internal.h"

enum { FIRST_DOUBLING = 16, PARTS = 8, PART_BITS = 3 }; /* the second bucket begins near 2^16 ns */
enum { NAK = 7, BUSY = 6 };                                /* Modbus exception codes */

_Static_assert(MD_STATUSES == 1 - MD_POLLING_FAILED, "every status has a place");

static int bucket(int64_t ns)
{
    if (ns < INT64_C(1) << FIRST_DOUBLING)
        return 0;
    int doubling = 63 - __builtin_clzll((unsigned long long)ns);
    int part = (int)(ns >> (doubling - PART_BITS)) & (PARTS - 1);
    int found = (doubling - FIRST_DOUBLING) * PARTS + part;
    return found < MD_DELAY_BUCKETS ? found : MD_DELAY_BUCKETS - 1;
}

int64_t md_delay_edge(int bucket)
{
    if (bucket <= 0)
        return 0;
    return (int64_t)(PARTS + bucket % PARTS) << (FIRST_DOUBLING - PART_BITS + bucket / PARTS);
}

void md_counters_end(const struct md_exchange *exchange, const struct md_completion *completion)
{
    struct md_drive *drive = exchange->drive;
    struct md_counters *counters = &drive->counters;
    uint64_t values = exchange->block ? (uint64_t)exchange->block->count : 1;
    if (completion->result == MD_LATE_ANSWER_DUE && completion->sent_ns)
        values = 0; /* they are read again */
    uint8_t exception = completion->reply.exception;
    counters->exchanges++;
    counters->sent += completion->sent_ns != 0;
    counters->stray_bytes += completion->stale + completion->skipped;
    counters->answered += completion->result > 0;
    if (completion->result <= 0)
        drive->history->ended[-completion->result]++;
    if (completion->result < 0) {
        drive->history->missed[-completion->result] += values;
    } else if (exception) {
        struct md_history *history = drive->history;
        history->exceptions++;
        history->naks += exception == NAK;
        history->busies += exception == BUSY;
        history->refused[exception] += (uint32_t)values;
    } else {
        const struct md_block *block = exchange->block;
        uint64_t lacking = block && block->may_lack ? md_count_lacking(block, &completion->reply) : 0;
        counters->values += values - lacking;
        if (lacking)
            drive->history->missed[MD_NO_VALUE] += lacking;
    }
}

void md_counters_answer(struct md_drive *drive, int64_t delay_ns, int64_t ideal_ns)
{
    struct md_counters *counters = &drive->counters;
    counters->ideal_ns += (uint64_t)ideal_ns;
    counters->longest_ns = later(counters->longest_ns, delay_ns);
    drive->delays[bucket(delay_ns)]++;
}

uint64_t md_replies(const struct md_drive *drive)
{
    return drive->counters.answered + drive->history->late + drive->doubtful;
}

const uint64_t *md_usual_delays(const struct md_drive *drive)
{
    return &drive->delays[bucket(drive->delay_ns)];
}
