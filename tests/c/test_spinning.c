/* At the end of the silence before a request, the engine's thread spins if the request is in its queue. It
 * sleeps if the request comes from a client's thread. */
#include "answered_port.h"

enum {
    BY_HAND = 50, MOST_TRIES = 500,
    FEW = 60 /* limit of clock readings per exchange; a spinning thread makes about 30 per us */
};
static const int64_t SILENCE_NS = 3000000;

/* ---- these functions replace clock.c ---- */

static atomic_int looks;

int64_t md_now_ns(void)
{
    struct timespec now;
    atomic_fetch_add(&looks, 1);
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * MD_SECOND_NS + now.tv_nsec;
}

int64_t md_utc_minus_monotonic_ns(void)
{
    return 0;
}

int64_t md_utc_ahead_ns(int64_t now_ns)
{
    (void)now_ns;
    return 0;
}

/* ---- exchanges ---- */

static void ask_by_hand(struct answered *drive)
{
    struct md_completion found;
    md_port_carry_out(drive->port, &drive->exchange, 0, 0, &found, NULL);
    assert(found.result > 0);
}

static void ask_queued(struct answered *drive)
{
    const struct md_progress *progress = md_port_progress(drive->port);
    const struct md_exchange *exchange = &drive->exchange;
    int64_t at_once = 0;
    md_port_submit(drive->port, &exchange, &at_once, 1);
    while (__atomic_load_n(&progress->done, __ATOMIC_SEQ_CST) != progress->submitted)
        poll(NULL, 0, 1);
}

/* Return how often the engine reads the clock during one exchange. */
static int looks_of(void (*ask)(struct answered *), struct answered *drive)
{
    int before = atomic_load(&looks);
    ask(drive);
    return atomic_load(&looks) - before;
}

int main(void)
{
    static struct answered drive;
    begin_answered(&drive, SILENCE_NS);

    int tries = 0; /* on a busy machine the thread may wake too late to spin */
    while (looks_of(ask_queued, &drive) <= FEW)
        assert(++tries < MOST_TRIES);
    for (int i = 0; i < BY_HAND; i++)
        assert(looks_of(ask_by_hand, &drive) <= FEW);

    end_answered(&drive);
    return 0;
}
