/* Lines driven on descriptors: the only file of the core that waits, reads and writes. */
#define _GNU_SOURCE
#include "multidrop.h"

#include <errno.h>
#include <poll.h>
#include <stdatomic.h>
#include <time.h>
#include <unistd.h>
#ifdef __linux__
#include <sys/prctl.h>
#endif

int64_t md_now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

void md_port_init(struct md_port *port, int fd, int must_take)
{
    *port = (struct md_port){.fd = fd, .must_take = must_take};
    md_line_init(&port->line, md_now_ns());
}

void md_port_yield(struct md_port *port, int yield_now)
{
    atomic_store((_Atomic int *)&port->yield_now, yield_now);
}

/* Wait for the descriptor or the time: is there something to do? Its errors show when it is read. */
static int wait_for(int fd, short events, int64_t until_ns)
{
    struct pollfd pollfd = {.fd = fd, .events = events};
    int64_t left = until_ns - md_now_ns();
    if (left < 0)
        left = 0;
#ifdef __linux__
    struct timespec span = {.tv_sec = left / 1000000000, .tv_nsec = left % 1000000000};
    return ppoll(&pollfd, 1, &span, NULL) > 0;
#else
    return poll(&pollfd, 1, (int)(left / 1000000)) > 0;
#endif
}

static int is_transient(int error)
{
    return error == EAGAIN || error == EWOULDBLOCK || error == EINTR;
}

static void pump_out(struct md_port *port)
{
    struct md_line *line = &port->line;
    int64_t before = md_now_ns();
    ssize_t written = write(port->fd, line->tx + line->tx_at, (size_t)(line->tx_len - line->tx_at));
    if (written > 0)
        md_line_sent(line, (size_t)written, before);
    else if (written < 0 && !is_transient(errno))
        md_line_lost(line, MD_LINE_LOST, errno);
    else
        wait_for(port->fd, POLLOUT, line->wake_ns);
}

static void pump_in(struct md_port *port)
{
    struct md_line *line = &port->line;
    uint8_t bytes[1024];
    if (!wait_for(port->fd, POLLIN, line->wake_ns))
        return;
    ssize_t got = read(port->fd, bytes, sizeof bytes);
    if (got > 0)
        md_line_received(line, bytes, (size_t)got, md_now_ns());
    else if (got == 0)
        md_line_lost(line, MD_LINE_LOST, 0);
    else if (!is_transient(errno))
        md_line_lost(line, MD_LINE_LOST, errno);
}

static int same_settings(const struct md_settings *a, const struct md_settings *b)
{
    return a->baudrate == b->baudrate && a->databits == b->databits && a->parity == b->parity && a->stopbits == b->stopbits;
}

static void apply_settings(struct md_port *port, const struct md_settings *settings)
{
    if (port->must_take < 0 || same_settings(&port->settings, settings))
        return;
    wait_for(-1, 0, port->line.quiet_ns); /* a broadcast may still be on its way out */
    int refused = md_port_set(port->fd, settings);
    if (refused < 0)
        md_line_lost(&port->line, MD_LINE_LOST, -refused);
    else if (refused & port->must_take)
        md_line_lost(&port->line, MD_SETTINGS_REFUSED, refused);
    else
        port->settings = *settings;
}

int md_run(struct md_port *port, const struct md_exchange *const *exchanges,
           struct md_completion *completions, int n)
{
    struct md_line *line = &port->line;
#ifdef __linux__
    prctl(PR_SET_TIMERSLACK, 1UL, 0UL, 0UL, 0UL); /* of this thread; the default is 50 us */
#endif
    for (int i = 0; i < n; i++) {
        if (atomic_load((_Atomic int *)&port->yield_now))
            return i;
        md_line_begin(line, exchanges[i], &completions[i], md_now_ns());
        apply_settings(port, &exchanges[i]->settings);
        int want;
        while ((want = md_line_want(line, md_now_ns())) != MD_DONE) {
            if (want == MD_WRITE)
                pump_out(port);
            else
                pump_in(port);
        }
        if (completions[i].result == MD_LINE_LOST || completions[i].result == MD_SETTINGS_REFUSED)
            return i + 1;
    }
    return n;
}
