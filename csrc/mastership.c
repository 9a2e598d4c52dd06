/* The deadline until which this process may send on its lines, and the kernel's timer that kills the process
 * if it is still suspended after that. Both use CLOCK_BOOTTIME, which includes the computer's sleep.
 *
 * Checking the clock is not enough: the process may be suspended between the check and write(2). The timer
 * works without the process, and the kernel can kill a suspended process. */
#include "engine.h"

#include <signal.h>
#include <stdlib.h>

#ifdef __linux__

static int set_timer(struct md_mastership *mastership, int64_t at_ns)
{
    struct itimerspec once = {.it_value = timespec_of(at_ns)}; /* time 0 disarms the timer */
    return timer_settime(mastership->timer, TIMER_ABSTIME, &once, NULL);
}

int64_t md_boottime_ns(void)
{
    return md_clock_ns(CLOCK_BOOTTIME);
}

struct md_mastership *md_mastership_new(int64_t guard_ns)
{
    struct md_mastership *mastership = calloc(1, sizeof *mastership);
    struct sigevent kill = {.sigev_notify = SIGEV_SIGNAL, .sigev_signo = SIGKILL};
    if (mastership && timer_create(CLOCK_BOOTTIME, &kill, &mastership->timer) == 0) {
        mastership->guard_ns = guard_ns;
        return mastership;
    }
    free(mastership);
    return NULL;
}

void md_mastership_free(struct md_mastership *mastership)
{
    timer_delete(mastership->timer);
    free(mastership);
}

#else

static int set_timer(struct md_mastership *mastership, int64_t at_ns)
{
    (void)mastership, (void)at_ns;
    errno = ENOSYS;
    return -1;
}

int64_t md_boottime_ns(void)
{
    return md_now_ns(); /* on macOS and Windows this clock includes sleep, too */
}

struct md_mastership *md_mastership_new(int64_t guard_ns)
{
    (void)guard_ns;
    errno = ENOSYS;
    return NULL;
}

void md_mastership_free(struct md_mastership *mastership)
{
    free(mastership);
}

#endif

int64_t md_mastership_until_ns(const struct md_mastership *mastership)
{
    return __atomic_load_n(&mastership->until_ns, __ATOMIC_SEQ_CST);
}

/* Read the deadline before the clock: if the process is suspended between the two reads, the deadline counts
 * as passed rather than as still valid. */
int md_mastership_holds(const struct md_mastership *mastership)
{
    int64_t until_ns = md_mastership_until_ns(mastership);
    return until_ns && md_boottime_ns() < until_ns;
}

/* Set the timer first, so that it guards every deadline. Set the term before the deadline, so that no
 * request leaves in a new term before the port has listened to the line. */
int md_mastership_extend(struct md_mastership *mastership, int64_t until_ns, int64_t kill_ns)
{
    if (set_timer(mastership, kill_ns))
        return -1;
    if (!md_mastership_holds(mastership))
        __atomic_add_fetch(&mastership->term, 1, __ATOMIC_SEQ_CST);
    __atomic_store_n(&mastership->until_ns, until_ns, __ATOMIC_SEQ_CST);
    return 0;
}
