/* The baseline for jitter: writes a request at fixed intervals, sleeps in between, and prints the delay of
 * each request in ns. */
#define _GNU_SOURCE
#include <errno.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/prctl.h>
#include <time.h>
#include <unistd.h>

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

int main(int argc, char **argv)
{
    if (argc != 4) {
        fprintf(stderr, "usage: bare_timer PERIOD_US TIMES DESCRIPTOR\n");
        return 2;
    }
    static const uint8_t request[8] = {0x01, 0x03, 0x00, 0x00, 0x00, 0x0A, 0xC5, 0xCD};
    int64_t period_ns = atoll(argv[1]) * 1000, due_ns = now_ns();
    int fd = atoi(argv[3]);
    uint8_t reply[256];
    prctl(PR_SET_TIMERSLACK, 1UL, 0UL, 0UL, 0UL);
    for (long left = atol(argv[2]); left > 0; left--) {
        due_ns += period_ns;
        struct timespec until = {.tv_sec = due_ns / 1000000000, .tv_nsec = due_ns % 1000000000};
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL) == EINTR)
            ;
        printf("%lld\n", (long long)(now_ns() - due_ns));
        if (write(fd, request, sizeof request) != sizeof request || read(fd, reply, sizeof reply) <= 0)
            return 1;
    }
    return 0;
}
