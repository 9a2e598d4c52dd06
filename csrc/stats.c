/* A drive's statistics: its counters, and its response delays, which determine when to read the port and how
 * long to wait. */
#include "internal.h"

/* ---- when to read the port ---- */

/* Read early: an early read costs one wake-up, but a late read delays the next request. Reads timed to the
 * exact end of replies saved one sleep of three, but lost 1/300 of the line's time, because sleeps end
 * late. */
static int64_t early_look_ns(const struct md_exchange *exchange)
{
    const struct md_drive *drive = exchange->drive;
    return later(0, drive->delay_ns - drive->deviation_ns - exchange->character_ns / 2);
}

/* If a client waits for values, each wake-up is expensive, because caches are cold. The client's own delays
 * are longer than the variation of a steady drive's delays. Therefore the port is read when the reply must
 * be complete. Only one read in SURE is early, to detect that replies have become faster. */
enum { SURE = 8 };

static int is_sure(const struct md_exchange *exchange)
{
    const struct md_drive *drive = exchange->drive;
    return exchange->values && drive->sure_looks && 2 * drive->deviation_ns <= exchange->character_ns;
}

int64_t md_look_ns(const struct md_exchange *exchange)
{
    const struct md_drive *drive = exchange->drive;
    return is_sure(exchange) ? drive->delay_ns + 2 * drive->deviation_ns : early_look_ns(exchange);
}

/* ---- how long to wait ---- */

/* The engine's thread writes these times; other threads read them at any time. */
static int64_t learnt(const int64_t *ns)
{
    return __atomic_load_n(ns, __ATOMIC_RELAXED);
}

static void learn(int64_t *ns, int64_t value)
{
    __atomic_store_n(ns, value, __ATOMIC_RELAXED);
}

/* Return the smoothed delay plus four deviations, as in TCP's retransmission timeout (RFC 6298). */
static int64_t usual_timeout_ns(const struct md_drive *drive)
{
    int64_t usual_ns = 3 * drive->least_timeout_ns, delay_ns = learnt(&drive->delay_ns);
    int64_t margin_ns = later(4 * learnt(&drive->deviation_ns), drive->least_timeout_ns / 4);
    if (delay_ns)
        usual_ns = later(delay_ns + margin_ns, drive->least_timeout_ns);
    return sooner(usual_ns, drive->most_timeout_ns);
}

/* The first request after a failure gets the longest timeout that the drive's document allows, because the
 * drive may have become slower. While the drive stays silent, only one request in RARELY gets that timeout,
 * because it takes line time from the other drives. A stop must be repeated sooner. Its timeout doubles after
 * each failure except the first one, because that belongs to the identity check. If replies are known to be
 * late, a stop may wait as long as its sender allows. */
enum { RARELY = 16, MOST_DOUBLINGS = 8 };
static const int64_t MOST_PATIENCE = INT64_C(20000000000);

int64_t md_timeout_ns(const struct md_exchange *exchange)
{
    const struct md_drive *drive = exchange->drive;
    if (exchange->insists) {
        int64_t doublings = drive->failures > 1 ? sooner(drive->failures - 1, MOST_DOUBLINGS) : 0;
        int64_t doubled_ns = usual_timeout_ns(drive) << doublings;
        int64_t late_ns = sooner(learnt(&drive->patience_ns), exchange->timeout_ns);
        return later(sooner(doubled_ns, drive->most_timeout_ns), late_ns);
    }
    return later(md_next_timeout_ns(drive), later(learnt(&drive->patience_ns), exchange->timeout_ns));
}

/* A write may wait longer than the drive's timeout; the window starts after that wait. */
int64_t md_window_ns(const struct md_exchange *exchange)
{
    const struct md_drive *drive = exchange->drive;
    int64_t longer_ns = later(md_timeout_ns(exchange) - md_next_timeout_ns(drive), 0);
    return longer_ns + later(3 * md_next_timeout_ns(drive), drive->most_timeout_ns);
}

int64_t md_present_timeout_ns(const struct md_drive *drive)
{
    return later(usual_timeout_ns(drive), learnt(&drive->patience_ns));
}

int64_t md_next_timeout_ns(const struct md_drive *drive)
{
    uint32_t failures = __atomic_load_n(&drive->failures, __ATOMIC_RELAXED);
    return failures % RARELY == 1 ? drive->most_timeout_ns : usual_timeout_ns(drive);
}

static void smooth(struct md_drive *drive, int64_t delay_ns)
{
    int64_t off_ns = delay_ns - drive->delay_ns;
    if (drive->delay_ns == 0) {
        learn(&drive->delay_ns, later(delay_ns, 1));
        learn(&drive->deviation_ns, delay_ns / 2);
        return;
    }
    int64_t deviation_ns = drive->deviation_ns;
    learn(&drive->deviation_ns, deviation_ns + ((off_ns < 0 ? -off_ns : off_ns) - deviation_ns) / 4);
    learn(&drive->delay_ns, later(drive->delay_ns + off_ns / 8, 1));
}

/* md_reply_due_ns() is only used to accept a copy of the request as the reply. It returns 0 for a stop's
 * reads, for which that is not needed. */
enum { WELL_KNOWN = 8 }; /* number of replies after which the delay is known well enough */

int64_t md_reply_due_ns(const struct md_exchange *exchange)
{
    const struct md_drive *drive = exchange->drive;
    int is_known = drive->counters.answered >= WELL_KNOWN && drive->delay_ns > 0;
    if (!is_known || exchange->insists || drive->failures || drive->owed_count || drive->patience_ns)
        return 0;
    return drive->delay_ns + later(4 * drive->deviation_ns, drive->least_timeout_ns / 8);
}

/* ---- late replies ---- */

/* Set the longer timeout, or 0 if it does not exceed the usual timeout. */
static void set_patience(struct md_drive *drive, int64_t patience_ns)
{
    learn(&drive->patience_ns, patience_ns > usual_timeout_ns(drive) ? patience_ns : 0);
}

int64_t md_learn_delay(const struct md_exchange *exchange, int64_t delay_ns, int is_whole)
{
    struct md_drive *drive = exchange->drive;
    if (is_whole && is_sure(exchange)) {
        drive->sure_looks--;
        delay_ns = sooner(delay_ns, drive->delay_ns);
    } else {
        drive->sure_looks = is_whole ? 0 : SURE - 1;
        if (is_whole) /* the measured delay is only an upper bound */
            delay_ns = sooner(delay_ns, early_look_ns(exchange));
        smooth(drive, delay_ns);
    }
    if (drive->patience_ns > 2 * delay_ns)
        set_patience(drive, drive->patience_ns - drive->patience_ns / 8);
    return delay_ns;
}

/* The longer timeout is 1.5 times the late reply's delay, because delays vary. If the request was sent
 * several times, it is unknown which one the reply answers. */
void md_learn_lateness(struct md_drive *drive, int64_t delay_ns, int is_exact)
{
    int64_t patience_ns = sooner(delay_ns + delay_ns / 2, MOST_PATIENCE);
    set_patience(drive, is_exact ? patience_ns : later(patience_ns, drive->patience_ns));
}

void md_learn_silence(struct md_drive *drive)
{
    if (drive->patience_ns)
        set_patience(drive, drive->patience_ns / 2);
}

/* ---- counters ---- */

/* Counters only grow, so the counts of a time span are the difference of two readings. Response delays are
 * counted in buckets, PARTS for each doubling of the delay. */
enum { FIRST_DOUBLING = 16, PARTS = 8, PART_BITS = 3 }; /* the second bucket of delays starts near 2^16 ns */
enum { NAK = 7, BUSY = 6 };                                /* Modbus exception codes */

_Static_assert(MD_STATUSES == 1 - MD_STALLED, "every status has a place");

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
        values = 0; /* do not count values as missing: the client reads them again */
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
