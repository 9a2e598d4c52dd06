/* Simulates eight hours of suspend as soon as the file SLEPT exists: all clocks but CLOCK_MONOTONIC
 * advance. Used with LD_PRELOAD. */
#define _GNU_SOURCE
#include <stdlib.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

int clock_gettime(clockid_t clock, struct timespec *now)
{
    const char *slept = getenv("SLEPT");
    int failed = (int)syscall(SYS_clock_gettime, clock, now);
    int ran_on = clock == CLOCK_BOOTTIME || clock == CLOCK_REALTIME;
    if (ran_on && slept && access(slept, F_OK) == 0)
        now->tv_sec += 8 * 3600;
    return failed;
}
