/* The system calls on a port's descriptor; on Windows, where it is a handle, functions of windows/. */
#ifndef MULTIDROP_DESCRIPTOR_H
#define MULTIDROP_DESCRIPTOR_H

#include <errno.h>
#include <stdint.h>
#include <sys/types.h>

#ifdef _WIN32

/* ---- windows/file.c ---- */

ssize_t md_descriptor_read(int fd, void *bytes, size_t room);
ssize_t md_descriptor_write(int fd, const void *bytes, size_t len);

/* ---- windows/rts.c ---- */

int md_descriptor_take_rs485(int fd);
int md_descriptor_set_rts(int fd, int is_up);
int md_descriptor_is_shifted_out(int fd);
int md_descriptor_is_queued(int fd);

#else

#include <sys/ioctl.h>
#include <unistd.h>
#ifdef __linux__ /* others have no RS-485 mode */
#include <linux/serial.h>
#endif

static inline ssize_t md_descriptor_read(int fd, void *bytes, size_t room)
{
    return read(fd, bytes, room);
}

static inline ssize_t md_descriptor_write(int fd, const void *bytes, size_t len)
{
    return write(fd, bytes, len);
}

/* Put the driver into its RS-485 mode; 0, -errno. */
static inline int md_descriptor_take_rs485(int fd)
{
#ifdef __linux__
    struct serial_rs485 mode;
    if (ioctl(fd, TIOCGRS485, &mode))
        return -errno;
    if (!(mode.flags & (SER_RS485_RTS_ON_SEND | SER_RS485_RTS_AFTER_SEND))) /* else as it was set up */
        mode.flags |= SER_RS485_RTS_ON_SEND;
    mode.flags |= SER_RS485_ENABLED;
    if (ioctl(fd, TIOCSRS485, &mode) || ioctl(fd, TIOCGRS485, &mode))
        return -errno;
    return mode.flags & SER_RS485_ENABLED ? 0 : -EOPNOTSUPP;
#else
    (void)fd;
    return -EOPNOTSUPP;
#endif
}

static inline int md_descriptor_set_rts(int fd, int is_up)
{
    int rts = TIOCM_RTS;
    return ioctl(fd, is_up ? TIOCMBIS : TIOCMBIC, &rts) ? -errno : 0;
}

/* Return 1 where the UART says that its last bit has left, 0 where not, -errno where it does not tell. */
static inline int md_descriptor_is_shifted_out(int fd)
{
#ifdef TIOCSERGETLSR
    unsigned state = 0;
    return ioctl(fd, TIOCSERGETLSR, &state) ? -errno : (state & TIOCSER_TEMT) != 0;
#else
    (void)fd;
    return -ENOTTY;
#endif
}

/* Return 1 where the driver says that it still holds bytes to be sent. */
static inline int md_descriptor_is_queued(int fd)
{
    int queued = 0;
    return ioctl(fd, TIOCOUTQ, &queued) == 0 && queued;
}

#endif
#endif
