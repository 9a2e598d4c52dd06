/* One port on the engine's thread: it reads, writes and switches settings until it must wait. */
#include "engine.h"

enum {
    WORTH_BLINDNESS = 200000, /* ns; in a shorter wait, go on watching the port to save system calls */
    HELD_UP_NS = 200000,      /* ns; a longer write(2) means that the thread was suspended */
    MOST_SPINNING = 4,        /* with more ports, do not spin: the processor has other work */
    NO_SLEEP_NS = 1000,       /* ns; a shorter sleep costs more than spinning */
    COUNT_LAG_NS = 100000000  /* ns; how late a driver may report that its bytes have left */
};
static const int64_t RETRY_WRITE_NS = 1000000;

static void watch(struct md_port *port, int is_watched)
{
    if (port->is_watched == is_watched || port->turn.progress.lost)
        return;
    md_waiter_change(port->engine->waiter, port->fd, port, is_watched);
    port->is_watched = is_watched;
}

/* Return 1 if the driver holds bytes that the adapter has not taken. On a network such bytes do not count:
 * they are unconfirmed, not unsent. */
static int is_holding(const struct md_port *port)
{
    return port->must_take >= 0 && !port->turn.progress.miscounts && md_descriptor_is_queued(port->fd);
}

/* Check the driver's count of unsent bytes after the next replies: it may be wrong. */
static void doubt_count(struct md_port *port)
{
    if (!port->doubts)
        port->doubts = MD_WRONG_COUNTS;
}

/* Return 1 while the driver may still count bytes as unsent although they have left: the reply to the last
 * request shows that they have. If the count stays above 0 after MD_WRONG_COUNTS such replies, ignore it. */
static int is_count_late(struct md_port *port, int64_t now_ns)
{
    struct md_line *line = &port->turn.line;
    if (!port->doubts || !line->is_answered)
        return 0;
    if (!is_holding(port)) {
        port->doubts = 0;
        return 0;
    }
    if (now_ns - line->quiet_ns < COUNT_LAG_NS)
        return 1;
    line->is_answered = 0; /* so that each reply is counted only once */
    if (--port->doubts == 0)
        md_store(&port->turn.progress.miscounts, 1);
    return 0;
}

/* Give up a port that failed. A command that the driver still holds is called off: the client closes the
 * port, and the driver then discards the command. */
static void lose(struct md_port *port, int error)
{
    struct md_line *line = &port->turn.line;
    if (md_line_is_under_way(line) && md_is_command(line->exchange) && is_holding(port))
        md_store(&port->turn.progress.called_off, 1);
    md_waiter_remove(port->engine->waiter, port->fd); /* a port that hung up is always readable */
    md_turn_lose(&port->turn, error);
}

static int is_transient(int error)
{
    return error == EAGAIN || error == EWOULDBLOCK || error == EINTR;
}

int64_t md_port_receive(struct md_port *port)
{
    uint8_t bytes[1024];
    ssize_t got = md_descriptor_read(port->fd, bytes, sizeof bytes);
    int64_t now_ns = md_now_ns();
    port->is_empty = got < (ssize_t)sizeof bytes;
    if (got > 0) {
        md_line_received(&port->turn.line, bytes, (size_t)got, now_ns);
        if (port->turn.line.is_out_of_step)
            lose(port, EPROTO);
    } else if (got == 0)
        lose(port, 0);
    else if (!is_transient(errno))
        lose(port, errno);
    return now_ns;
}

/* Return 1 if this process may still send, 0 if the request must wait or has ended. Call this right before
 * write(2); only a switch of the transceiver by RTS may come in between. */
static int may_send(struct md_port *port)
{
    struct md_line *line = &port->turn.line;
    if (!md_mastership_holds(port->mastership)) {
        port->heard_term = 0;
        md_line_abandon(line, MD_NOT_MASTER, 0);
        return 0;
    }
    uint32_t term = md_load(&port->mastership->term);
    if (port->heard_term == term || line->tx_at > 0 || line->exchange->insists)
        return 1;
    port->heard_term = term;
    return !md_listen_begin(line, md_now_ns(), port->mastership->guard_ns);
}

/* Return 1 if the request has expired, by a clock that includes the computer's sleep. */
static int is_expired(const struct md_turn *turn)
{
    if (turn->source != MD_URGENT || turn->line.tx_at > 0)
        return 0;
    return turn->urgent->expires_ns && md_boottime_ns() > turn->urgent->expires_ns;
}

/* Note at a timeout whether the adapter has taken the request. If it has not, and the request is a command,
 * give up the port: the client closes it, and the driver then discards the command. */
static void check_stall(struct md_port *port)
{
    struct md_turn *turn = &port->turn;
    int is_stalled = is_holding(port);
    if (turn->progress.stalled != (uint32_t)is_stalled)
        md_store(&turn->progress.stalled, (uint32_t)is_stalled);
    port->taken_ns = is_stalled ? MD_NEVER : 0;
    if (is_stalled)
        doubt_count(port);
    if (!is_stalled || !md_is_command(turn->line.exchange))
        return;
    md_store(&turn->progress.called_off, 1);
    lose(port, ETIMEDOUT);
}

/* Return 1 until a stalled adapter has taken all bytes, and then until all replies to them must have come:
 * such a reply could be mistaken for the reply to the next read. A stop's reads do not wait for replies. */
static int must_recover(struct md_port *port, int64_t now_ns)
{
    const struct md_line *line = &port->turn.line;
    const struct md_exchange *exchange = line->exchange;
    int was_wrong = port->doubts > 0 && port->doubts < MD_WRONG_COUNTS;
    if (!port->turn.progress.stalled || now_ns - line->quiet_ns > md_line_hold_ns(line, was_wrong))
        return 0;
    if (is_holding(port))
        port->taken_ns = MD_NEVER;
    else if (port->taken_ns == MD_NEVER)
        port->taken_ns = now_ns;
    if (port->taken_ns == MD_NEVER)
        return 1;
    return !exchange->insists && now_ns - port->taken_ns < exchange->drive->most_timeout_ns;
}

/* Return 1 if the request must wait until the adapter has taken earlier bytes. Otherwise a command could
 * leave too late, and a read could delay a stop that comes later. The check is a system call. It is only made
 * for commands, during a stall, and while the driver's count is in doubt. */
static int must_wait(struct md_port *port, int64_t now_ns)
{
    struct md_line *line = &port->turn.line;
    const struct md_exchange *exchange = line->exchange;
    if (line->tx_at > 0)
        return 0;
    int is_late = !exchange->insists && is_count_late(port, now_ns);
    if (md_is_read(exchange->framing, exchange->request.function)) {
        line->is_held = (uint8_t)(is_late || must_recover(port, now_ns));
        return line->is_held;
    }
    int is_held = !exchange->insists && is_holding(port);
    if (is_held)
        doubt_count(port);
    return is_held;
}

/* Write the request; return 1 if the port took bytes or has other work. The send time is the start of the
 * write. If the thread was suspended during the write, the send time is the end of the write: with too
 * early a time, the waits for the reply and for late replies would be too short. */
static int write_request(struct md_port *port, int64_t begun_ns)
{
    struct md_line *line = &port->turn.line;
    if (is_expired(&port->turn)) {
        md_line_abandon(line, MD_EXPIRED, 0);
        return 1;
    }
    if (port->mastership && !may_send(port))
        return 1;
    if (must_wait(port, begun_ns))
        return 0;
    ssize_t written = md_rs485_write(port, line->tx + line->tx_at, (size_t)(line->tx_len - line->tx_at));
    int64_t done_ns = md_now_ns();
    if (written > 0) {
        if (!line->completion->sent_ns)
            line->completion->utc_ahead_ns = md_utc_ahead_ns(done_ns);
        md_line_sent(line, (size_t)written, begun_ns, done_ns - begun_ns > HELD_UP_NS ? done_ns : begun_ns);
    } else if (written < 0 && !is_transient(errno))
        lose(port, errno);
    return written != 0 && (written > 0 || port->turn.progress.lost);
}

static int is_in_force(const struct md_port *port, const struct md_settings *wanted)
{
    const struct md_settings *settings = &port->settings;
    return port->must_take < 0 ||
           (settings->baudrate == wanted->baudrate && settings->databits == wanted->databits &&
            settings->parity == wanted->parity && settings->stopbits == wanted->stopbits);
}

static int64_t apply(struct md_port *port, const struct md_settings *settings)
{
    struct md_progress *progress = &port->turn.progress;
    int64_t begun_ns = md_now_ns();
    int refused = md_port_set(port->fd, settings);
    int64_t now_ns = md_now_ns();
    port->turn.line.wake_ns += now_ns - begun_ns; /* add the time in which the port took no bytes */
    progress->switching_ns += now_ns - begun_ns;
    md_store(&progress->switches, progress->switches + 1);
    port->settings = *settings;
    if (refused < 0 || (refused & port->must_take))
        port->settings = (struct md_settings){0}; /* unknown: the port may have taken some of the settings */
    if (refused < 0)
        lose(port, -refused);
    else if (refused & port->must_take)
        md_line_abandon(&port->turn.line, MD_SETTINGS_REFUSED, refused);
    return now_ns;
}

static int is_sent(const struct md_port *port)
{
    return port->turn.source != MD_NO_SOURCE && port->turn.line.completion->sent_ns;
}

/* Return 1 if the thread should spin before a request. Every wake-up is late, by about the same time. So the
 * thread wakes earlier by that time, and spins until the request is due, for some 20 us of each exchange. It
 * spins only with few ports, and not for a client that waits: the client's own delays are longer and vary
 * more. It does not spin before the read of a reply either, because that read may be early. */
static int is_worth_spinning(const struct md_port *port)
{
    return port->engine->count <= MOST_SPINNING && port->turn.source != MD_URGENT;
}

static int spin_until(struct md_port *port, int64_t until_ns, int64_t *now_ns)
{
    int64_t most_ns = is_worth_spinning(port) ? MD_MOST_LATENESS : NO_SLEEP_NS;
    if (until_ns - *now_ns > most_ns || port->turn.progress.lost)
        return 0;
    if (!port->is_empty) /* the driver may hold bytes: read them while there is time */
        *now_ns = md_port_receive(port);
    while (*now_ns < until_ns)
        *now_ns = md_now_ns();
    return 1;
}

/* Carry out the wanted action; return 1 if the next action can follow immediately. */
static int act(struct md_port *port, int want, int64_t *wake_ns, int64_t *now_ns)
{
    const struct md_exchange *exchange = port->turn.line.exchange;
    switch (want) {
    case MD_WRITE: /* return after a change of settings: a stop may have come meanwhile */
        if (!is_in_force(port, &exchange->settings)) {
            *now_ns = apply(port, &exchange->settings);
            return 1;
        }
        if (write_request(port, *now_ns))
            return 1;
        *wake_ns = *now_ns + RETRY_WRITE_NS;
        return 0;
    case MD_READ:
        if (!port->is_blind && *now_ns < *wake_ns)
            return 0;
        port->is_blind = 0;
        if (!port->is_empty)
            *now_ns = md_port_receive(port);
        if (port->turn.line.state == MD_LAST_LOOK)
            check_stall(port);
        return 1;
    case MD_WAIT:
        return !is_sent(port) && spin_until(port, *wake_ns, now_ns);
    default:
        return spin_until(port, *wake_ns, now_ns);
    }
}

/* Return 1 if a client that reads repeatedly will read again before the line's silence is over. The thread
 * wakes at the end of the silence, so the client need not wake it. */
static int is_client_expected(const struct md_turn *turn, int64_t now_ns)
{
    return turn->source == MD_NO_SOURCE && turn->last == MD_URGENT &&
           md_line_silent_ns(&turn->line) - now_ns > MD_MOST_LATENESS;
}

static int64_t direction_ns(const struct md_port *port)
{
    return port->rs485.is_sending ? port->rs485.look_ns : MD_NEVER;
}

int64_t md_port_advance(struct md_port *port, int64_t now_ns)
{
    struct md_turn *turn = &port->turn;
    struct md_engine *engine = port->engine;
    int64_t wake_ns;
    int want, failure = md_rs485_look(port, now_ns);
    if (failure && !turn->progress.lost)
        lose(port, -failure);
    if (port->is_closing) { /* only wait until the last request has been sent */
        engine->wakes[port->index] = direction_ns(port);
        return now_ns;
    }
    do
        want = md_turn_want(turn, &wake_ns, now_ns);
    while (act(port, want, &wake_ns, &now_ns));
    if (turn->has_done_urgent) {
        turn->has_done_urgent = 0;
        engine->has_news = 1;
    }
    int is_expected = is_client_expected(turn, now_ns);
    if (is_expected)
        wake_ns = sooner(wake_ns, md_line_silent_ns(&turn->line));
    port->is_empty = 0;
    port->is_blind = want == MD_WAIT || is_expected || (port->is_blind && want == MD_WRITE);
    if (port->is_blind && wake_ns - now_ns > WORTH_BLINDNESS)
        watch(port, 0);
    else if (!port->is_blind)
        watch(port, 1);
    int is_early = wake_ns != MD_NEVER && (port->is_blind || turn->source == MD_NO_SOURCE) &&
                   (is_sent(port) || (is_worth_spinning(port) && !is_expected));
    wake_ns -= is_early ? engine->lateness_ns : 0;
    engine->wakes[port->index] = sooner(wake_ns, direction_ns(port));
    return now_ns;
}
