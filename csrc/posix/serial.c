/* A serial port's descriptor: its speed and character format, and closing it in bounded time. */
#define _GNU_SOURCE
#include "internal.h"

#include <errno.h>
#include <unistd.h>

#ifdef __linux__
#include <asm/termbits.h>
#include <linux/serial.h>
#include <pthread.h>
#include <signal.h>
#include <sys/ioctl.h>
#include <sys/syscall.h>
#else
#include <termios.h>
#endif

/* ---- speed and character format: set them, then read back the values that the driver took ---- */

/* tcsetattr() fails with EINVAL if no requested change took effect: for example, a pty could not be reopened
 * with even parity. On Linux ioctl() is used instead, which does not fail then and takes any speed. On other
 * systems the speed is set in the termios structure. */

#ifdef __linux__
#ifndef TCGETS2 /* musl does not define these requests, and its ioctl() takes an int */
#define TCGETS2 ((int)_IOR('T', 0x2A, struct termios2))
#define TCSETS2 ((int)_IOW('T', 0x2B, struct termios2))
#endif
typedef struct termios2 attributes;

static int get(int fd, attributes *now)
{
    return ioctl(fd, TCGETS2, now) ? -errno : 0;
}

static int put(int fd, const attributes *wanted)
{
    return ioctl(fd, TCSETS2, wanted) ? -errno : 0;
}

static int set(int fd, attributes *wanted, uint32_t baudrate)
{
    wanted->c_cflag &= ~(tcflag_t)(CBAUD | CBAUD << IBSHIFT | CMSPAR);
    wanted->c_cflag |= BOTHER | BOTHER << IBSHIFT;
    wanted->c_ispeed = wanted->c_ospeed = baudrate;
    return put(fd, wanted);
}

static uint32_t speed(const attributes *now)
{
    return now->c_ospeed;
}
#else
typedef struct termios attributes;

static int get(int fd, attributes *now)
{
    return tcgetattr(fd, now) ? -errno : 0;
}

static int put(int fd, const attributes *wanted)
{
    return tcsetattr(fd, TCSANOW, wanted) && errno != EINVAL ? -errno : 0;
}

static int set(int fd, attributes *wanted, uint32_t baudrate)
{
    if (cfsetispeed(wanted, baudrate) || cfsetospeed(wanted, baudrate))
        return -errno;
    return put(fd, wanted);
}

static uint32_t speed(const attributes *now)
{
    return (uint32_t)cfgetospeed(now);
}
#endif

#ifndef CRTSCTS /* POSIX does not define hardware flow control */
#define CRTSCTS 0
#endif

static struct md_settings describe(const attributes *now)
{
    return (struct md_settings){
        .baudrate = speed(now),
        .databits = (now->c_cflag & CSIZE) == CS7 ? 7 : 8,
        .parity = !(now->c_cflag & PARENB) ? 'N' : now->c_cflag & PARODD ? 'O' : 'E',
        .stopbits = now->c_cflag & CSTOPB ? 2 : 1,
    };
}

/* Adapters report the speed that their divisor yields. Receivers tolerate a deviation of 2 %, which is also
 * the kernel's limit. */
static int is_near(uint32_t baudrate, uint32_t wanted)
{
    uint32_t off = baudrate > wanted ? baudrate - wanted : wanted - baudrate;
    return off <= wanted / 50;
}

#ifdef __linux__
/* An 8250 divides its clock by a whole number, but its driver reports the baud rate that was requested. */
static int is_dividable(int fd, uint32_t baudrate)
{
    struct serial_struct uart;
    if (ioctl(fd, TIOCGSERIAL, &uart) || uart.type == PORT_16C950) /* the 16C950 has a prescaler */
        return 1;
    uint32_t base = (uint32_t)uart.baud_base;
    if (uart.baud_base <= 0 || baudrate == 0 || baudrate > base)
        return 1;
    int is_custom = ((unsigned)uart.flags & ASYNC_SPD_MASK) == ASYNC_SPD_CUST && baudrate == 38400;
    uint32_t divisor = is_custom ? (uint32_t)uart.custom_divisor : (base + baudrate / 2) / baudrate;
    return divisor > 0 && is_near(base / divisor, baudrate);
}

uint32_t md_port_baud_base(int fd)
{
    struct serial_struct uart;
    return ioctl(fd, TIOCGSERIAL, &uart) || uart.baud_base < 0 ? 0 : (uint32_t)uart.baud_base;
}
#else
static int is_dividable(int fd, uint32_t baudrate)
{
    (void)fd, (void)baudrate;
    return 1;
}

uint32_t md_port_baud_base(int fd)
{
    (void)fd;
    return 0;
}
#endif

int md_port_get(int fd, struct md_settings *settings)
{
    attributes now;
    int failure = get(fd, &now);
    if (!failure)
        *settings = describe(&now);
    return failure;
}

int md_port_keep_rts(int fd)
{
    attributes port;
    int failure = get(fd, &port);
    if (failure)
        return failure;
    port.c_cflag &= ~(tcflag_t)HUPCL;
    return put(fd, &port);
}

int md_port_set(int fd, const struct md_settings *settings)
{
    attributes port;
    int failure = get(fd, &port);
    if (failure)
        return failure;
    port.c_iflag = 0;
    port.c_oflag = 0;
    port.c_lflag = 0;
    port.c_cflag &= ~(tcflag_t)(CSIZE | PARENB | PARODD | CSTOPB | CRTSCTS);
    port.c_cflag |= CREAD | CLOCAL;
    port.c_cflag |= settings->databits == 7 ? CS7 : CS8;
    port.c_cflag |= settings->stopbits == 2 ? CSTOPB : 0;
    port.c_cflag |= settings->parity == 'N' ? 0 : settings->parity == 'O' ? PARENB | PARODD : PARENB;
    /* Drop characters with a parity error: their frame is damaged, and must not look whole. */
    port.c_iflag |= settings->parity == 'N' ? 0 : INPCK | IGNPAR;
    port.c_cc[VMIN] = 1;
    port.c_cc[VTIME] = 0;
    if ((failure = set(fd, &port, settings->baudrate)) != 0 || (failure = get(fd, &port)) != 0)
        return failure;
    struct md_settings taken = describe(&port);
    return (!is_near(taken.baudrate, settings->baudrate) ? MD_REFUSED_BAUDRATE : 0) |
           (!is_dividable(fd, settings->baudrate) ? MD_REFUSED_DIVISOR : 0) |
           (taken.databits != settings->databits ? MD_REFUSED_DATABITS : 0) |
           (taken.parity != settings->parity ? MD_REFUSED_PARITY : 0) |
           (taken.stopbits != settings->stopbits ? MD_REFUSED_STOPBITS : 0);
}

/* ---- closing ---- */

/* On Linux closing waits up to 30 s for the adapter to take the driver's bytes (closing_wait, which only
 * root may change). A signal to the closing thread ends the wait, and the driver then discards the bytes. A
 * timer sends this signal to the closing thread only. The program does not otherwise use the signal.
 *
 * The port is closed by dup2(2). It needs no free descriptor, and leaves one for pyserial to close. */

#ifdef __linux__
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
