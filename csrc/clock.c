/* Reads the monotonic clock, and by how much the time of day is ahead of it. */
#include "internal.h"

enum { WRONG_NS = 100000 }; /* a kept difference that is off by more is replaced */

static int64_t read_clock(clockid_t clock)
{
    struct timespec now;
    clock_gettime(clock, &now);
    return now.tv_sec * MD_SECOND_NS + now.tv_nsec;
}

int64_t md_now_ns(void)
{
    return read_clock(CLOCK_MONOTONIC);
}

int64_t md_utc_minus_monotonic_ns(void)
{
    static _Atomic int64_t kept;
    int64_t before_ns = md_now_ns(), utc_ns = read_clock(CLOCK_REALTIME), after_ns = md_now_ns();
    int64_t known = atomic_load(&kept), found = utc_ns - before_ns;
    int is_known = after_ns - before_ns < WRONG_NS; /* else this thread was interrupted between the two */
    int is_right = found - known <= WRONG_NS && known - found <= WRONG_NS;
    if (known && (is_right || !is_known))
        return known;
    /* Where two threads replace it at once, both return what the first one kept. */
    return atomic_compare_exchange_strong(&kept, &known, found) ? found : known;
}
