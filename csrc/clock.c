/* The monotonic clock, and its offset from UTC. */
#include "internal.h"

enum {
    WRONG_NS = 100000, /* ns; replace the stored offset between the clocks if its error is larger */
    MOST_TRIES = 4     /* attempts to read both clocks without an interruption in between */
};

int64_t md_now_ns(void)
{
    return md_clock_ns(CLOCK_MONOTONIC);
}

int64_t md_utc_ahead_ns(int64_t now_ns)
{
    static _Atomic int64_t kept;
    int64_t known = atomic_load(&kept), found = 0;
    int is_interrupted = 1;
    for (int i = 0; i < MOST_TRIES && is_interrupted; i++) {
        found = md_clock_ns(CLOCK_REALTIME) - now_ns;
        if (known && found - known <= WRONG_NS && known - found <= WRONG_NS)
            return known;
        int64_t after_ns = md_now_ns();
        is_interrupted = after_ns - now_ns >= WRONG_NS;
        now_ns = is_interrupted ? after_ns : now_ns;
    }
    if (known && is_interrupted)
        return known;
    /* If two threads replace the offset at the same time, both return the value of the first one. */
    return atomic_compare_exchange_strong(&kept, &known, found) ? found : known;
}

int64_t md_utc_minus_monotonic_ns(void)
{
    return md_utc_ahead_ns(md_now_ns());
}
