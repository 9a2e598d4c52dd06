/* Set a port's speed and character format, then read back the values that the driver took.
 *
 * tcsetattr() fails with EINVAL if no requested change took effect: for example, a pty could not be reopened
 * with even parity. On Linux ioctl() is used instead, which does not fail then and takes any speed. On other
 * systems the speed is set in the termios structure. */
#include "internal.h"

#include <errno.h>

#ifdef __linux__
#include <asm/termbits.h>
#include <linux/serial.h>
#include <sys/ioctl.h>
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
#include <termios.h>
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
