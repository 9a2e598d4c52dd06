/* Close a serial port in bounded time.
 *
 * On Linux closing waits up to 30 s for the adapter to take the driver's bytes (closing_wait, which only
 * root may change). A signal to the closing thread ends the wait, and the driver then discards the bytes. A
 * timer sends this signal to the closing thread only. The program does not otherwise use the signal.
 *
 * The port is closed by dup2(2). It needs no free descriptor, and leaves one for pyserial to close. */
#define _GNU_SOURCE
#include "internal.h"

#include <errno.h>
#include <unistd.h>

#ifdef __linux__
#include <pthread.h>
#include <signal.h>
#include <sys/syscall.h>

#ifndef sigev_notify_thread_id /* glibc before 2.38 */
#define sigev_notify_thread_id _sigev_un._tid
#endif

/* ns; the signal is repeated, because the first one may come before the wait */
static const int64_t AGAIN_NS = 20000000;

static void interrupt(int number)
{
    (void)number;
}

/* Return 1 if the program does not use the signal: it is not blocked, as for sigwait(2), and has no handler
 * but this file's. */
static int is_free(int number, const sigset_t *blocked)
{
    struct sigaction now;
    if (sigismember(blocked, number) || sigaction(number, NULL, &now) || now.sa_flags & SA_SIGINFO)
        return 0;
    return now.sa_handler == SIG_DFL || now.sa_handler == interrupt;
}

/* Return a real-time signal whose handler does nothing; -1 if all are in use. */
static int take_signal(void)
{
    struct sigaction ours = {.sa_handler = interrupt, .sa_flags = SA_RESTART};
    sigset_t blocked;
    pthread_sigmask(SIG_BLOCK, NULL, &blocked);
    for (int number = SIGRTMAX; number >= SIGRTMIN; number--)
        if (is_free(number, &blocked) && sigaction(number, &ours, NULL) == 0)
            return number;
    return -1;
}

int md_port_close(int fd, int other, int64_t most_ns)
{
    struct sigevent event = {.sigev_notify = SIGEV_THREAD_ID, .sigev_signo = take_signal()};
    struct itimerspec times = {timespec_of(AGAIN_NS), timespec_of(later(most_ns, 1))};
    timer_t timer;
    event.sigev_notify_thread_id = (pid_t)syscall(SYS_gettid);
    int is_timed = event.sigev_signo > 0 && timer_create(CLOCK_MONOTONIC, &event, &timer) == 0;
    if (is_timed)
        timer_settime(timer, 0, &times, NULL);
    int failure = dup2(other, fd) < 0 ? -errno : 0;
    if (is_timed)
        timer_delete(timer);
    return failure;
}

#else

int md_port_close(int fd, int other, int64_t most_ns)
{
    (void)most_ns;
    return dup2(other, fd) < 0 ? -errno : 0;
}

#endif
