/* Simulates RTS and RS-485 modes on pseudo-terminals, which have neither; used with LD_PRELOAD.
 * The file RS485_LOG has a line for each RTS change and for each later write: time in ns, kind, bytes.
 * The simulated UART is empty RS485_CHARACTER_NS per byte after a write. RTS fails after RS485_CALLS
 * calls; 0: the port has no RTS. With RS485_FLAGS the driver has its own RS-485 mode, with these flags. */
#define _GNU_SOURCE
#include <asm/ioctls.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/serial.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

enum { RTS = 0x004 };

static int port = -1;
static int64_t end_ns;

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

static int64_t number(const char *name)
{
    const char *text = getenv(name);
    return text ? atoll(text) : -1;
}

static void note(int64_t time_ns, const char *what, long count)
{
    char line[80];
    int len = snprintf(line, sizeof line, "%lld %s %ld\n", (long long)time_ns, what, count);
    int log = open(getenv("RS485_LOG"), O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600);
    syscall(SYS_write, log, line, (size_t)len);
    close(log);
}

static int refuse(int error)
{
    errno = error;
    return -1;
}

static int switch_rts(int fd, int is_up)
{
    static int64_t calls;
    port = fd;
    if (number("RS485_CALLS") >= 0 && calls++ >= number("RS485_CALLS")) {
        note(now_ns(), "broken", 0);
        return refuse(number("RS485_CALLS") ? EIO : ENOTTY);
    }
    note(now_ns(), is_up ? "up" : "down", 0);
    return 0;
}

static int own_mode(unsigned long request, struct serial_rs485 *mode)
{
    static int64_t flags = -1;
    if (flags < 0 && (flags = number("RS485_FLAGS")) < 0)
        return refuse(ENOTTY);
    if (request == TIOCSRS485)
        note(now_ns(), "mode", (long)(flags = mode->flags));
    memset(mode, 0, sizeof *mode);
    mode->flags = (uint32_t)flags;
    return 0;
}

int ioctl(int fd, unsigned long request, ...)
{
    va_list arguments;
    va_start(arguments, request);
    void *argument = va_arg(arguments, void *);
    va_end(arguments);
    if ((request == TIOCMBIS || request == TIOCMBIC) && *(int *)argument == RTS)
        return switch_rts(fd, request == TIOCMBIS);
    if (request == TIOCGRS485 || request == TIOCSRS485)
        return own_mode(request, argument);
    if (request == TIOCMBIS || request == TIOCMBIC)
        return 0; /* succeed for DTR, because pyserial sets RTS only then */
    if (request == TIOCSERGETLSR) {
        *(unsigned *)argument = now_ns() >= end_ns ? TIOCSER_TEMT : 0;
        return 0;
    }
    return (int)syscall(SYS_ioctl, fd, request, argument);
}

ssize_t write(int fd, const void *bytes, size_t len)
{
    if (fd == port) {
        int64_t begun_ns = now_ns();
        end_ns = (end_ns > begun_ns ? end_ns : begun_ns) + (int64_t)len * number("RS485_CHARACTER_NS");
        note(begun_ns, "write", (long)len);
    }
    return syscall(SYS_write, fd, bytes, len);
}
