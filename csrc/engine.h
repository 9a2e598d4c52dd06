/* The engine and its ports, as its thread and its clients see them. Calls run one way: api.c (clients)
 * -> engine.c (the thread) -> port.c (a port's system calls) -> turn.c -> line.c. */
#ifndef MULTIDROP_ENGINE_H
#define MULTIDROP_ENGINE_H

#include "line.h"

#include <errno.h>
#include <sys/types.h>

enum { MD_WRONG_COUNTS = 3 }; /* after so many wrong counts of unsent bytes, the driver's count is ignored */

/* The state of the transceiver's direction. */
struct md_rs485 {
    int mode;        /* enum md_rs485_mode */
    int reports_end; /* 1: the driver reports when the last bit has left */
    int is_sending;  /* 1: RTS now switches the transceiver to sending */
    int64_t sent_ns; /* when the last bit leaves, if the UART sends without delay */
    int64_t look_ns; /* when to check next whether the last bit has left */
    int64_t empty_ns; /* when the driver's queue was found empty; 0: not found yet */
    int64_t wire_ns; /* duration on the wire of all bytes written since RTS was switched to sending */
};

struct md_port {
    /* fields that every exchange uses */
    int fd;
    int must_take;     /* mask of the settings whose refusal is a failure; -1: the port has no settings */
    unsigned index;    /* index among the engine's ports */
    int is_blind;      /* 1: the port is not watched, because no useful bytes come before its wake time */
    int is_watched;    /* the waiter reports when the port is readable */
    int is_empty;      /* 1: the last read left no bytes in the driver */
    /* number of further wrong counts until the driver's count is ignored; 0: it is trusted or ignored */
    int doubts;
    int is_closing;
    struct md_settings settings; /* the port's present settings; baudrate 0: unknown */
    struct md_engine *engine;
    const struct md_mastership *mastership; /* NULL: this process is always the master */
    struct md_rs485 rs485;
    struct md_turn turn;

    int64_t taken_ns;     /* time at which a stalled adapter had taken all bytes; MD_NEVER: not yet */
    uint32_t heard_term;  /* number of the term in which the port last listened to the line; 0: none */
    struct md_port *next; /* next port in the engine's list of arriving ports */
    int is_opened, open_error, is_closed;
};

struct md_engine {
    pthread_t thread;
    pthread_mutex_t mutex;  /* guards the fields below and the ports; the thread unlocks it only to wait */
    atomic_int callers;     /* clients that want the mutex */
    pthread_cond_t changed; /* signals the end of an urgent request, or that a port has opened or closed */
    int has_news;           /* 1: `changed` must be signalled */
    struct md_waiter *waiter;
    struct md_wakeup wakeup;
    struct md_port *arriving; /* ports to be added; their clients wait */
    struct md_port **ports;
    int64_t *wakes; /* for each port, the time by which the thread must wake */
    unsigned count, room;
    int64_t lateness_ns; /* how late the thread usually wakes from a sleep */
    struct md_realtime realtime;
    int wants_realtime;      /* requested change: 1: start realtime scheduling, 0: end it */
    int realtime_failure;    /* 0 or -errno */
    int is_realtime_changed; /* 1: the requested change is done */
};

/* This process's right to send on its lines, which ends at a deadline. Each time that the process gets the
 * right again, a new term starts. */
struct md_mastership {
    int64_t until_ns;         /* deadline by CLOCK_BOOTTIME; accessed atomically; 0: no right to send */
    int64_t guard_ns;         /* least time between the requests of two masters */
    uint32_t term;            /* number of the latest term; between two terms another process may be master */
    struct md_engine *engine; /* the engine whose ports check this mastership; NULL: no port yet */
#ifdef __linux__
    timer_t timer;
#endif
};

/* The longest expected lateness of a wake-up, in ns. */
#ifdef _WIN32
enum { MD_MOST_LATENESS = 1500000 }; /* Windows' best timers are 0.5 to 1 ms late */
#else
enum { MD_MOST_LATENESS = 80000 };
#endif

/* ---- engine.c: for clients ---- */

void md_engine_enter(struct md_engine *engine); /* take the mutex */
void md_engine_leave(struct md_engine *engine);
void md_engine_wake(struct md_engine *engine);
void md_engine_await(struct md_engine *engine, const int *is_done); /* the caller holds the mutex */

/* ---- port.c: on the engine's thread ---- */

int64_t md_port_receive(struct md_port *port); /* read the port; return the time of the read */
/* Carry out all actions that are due on a port; return the time afterwards. */
int64_t md_port_advance(struct md_port *port, int64_t now_ns);

/* ---- rs485.c ---- */

int md_rs485_begin(struct md_port *port, int mode, int is_usb); /* 0, -errno */
/* Switch the transceiver to sending, then write; return the same as write(2). */
ssize_t md_rs485_write(struct md_port *port, const uint8_t *bytes, size_t len);
/* Switch the transceiver to receiving if the last bit has left; return 0, or -errno if the port is lost. */
int md_rs485_look(struct md_port *port, int64_t now_ns);

/* ---- system calls on a descriptor; windows/ implements them on a handle ---- */

#ifdef _WIN32

/* ---- windows/file.c ---- */

ssize_t md_descriptor_read(int fd, void *bytes, size_t room);
ssize_t md_descriptor_write(int fd, const void *bytes, size_t len);

/* ---- windows/com.c ---- */

int md_descriptor_take_rs485(int fd);
int md_descriptor_set_rts(int fd, int is_up);
int md_descriptor_is_shifted_out(int fd);
int md_descriptor_is_queued(int fd);

#else

#include <sys/ioctl.h>
#include <unistd.h>
#ifdef __linux__ /* other systems have no RS-485 mode */
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

/* Switch the driver to its RS-485 mode; return 0 or -errno. */
static inline int md_descriptor_take_rs485(int fd)
{
#ifdef __linux__
    struct serial_rs485 mode;
    if (ioctl(fd, TIOCGRS485, &mode))
        return -errno;
    /* keep the polarity of RTS if it is configured */
    if (!(mode.flags & (SER_RS485_RTS_ON_SEND | SER_RS485_RTS_AFTER_SEND)))
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

/* Return 1 if the UART reports that its last bit has left, 0 if not, -errno if it cannot report that. */
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

/* Return 1 if the driver reports that its queue has unsent bytes. */
static inline int md_descriptor_is_queued(int fd)
{
    int queued = 0;
    return ioctl(fd, TIOCOUTQ, &queued) == 0 && queued;
}

#endif
#endif
