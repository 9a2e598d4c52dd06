/* One port, on the engine's thread: whose turn it is, and what is done until there is nothing to do but
 * to wait. An urgent exchange goes ahead of all, then comes what is queued and due, and else what is
 * repeated. These two keep a share of the line beside urgent exchanges without end, but for those that
 * insist. What became of it goes to the client's row_queue. */
#define _GNU_SOURCE
#include "engine.h"

#include <errno.h>
#include <unistd.h>

enum {
    WORTH_BLINDNESS = 200000, /* ns; a shorter wait is not worth the system calls to look away */
    HELD_UP_NS = 200000,      /* no write takes so long by itself */
    MOST_SPINNING = 4,        /* ports; with more of them the processor has better to do */
    POLLED = 20,              /* one part in so many of a line that urgent exchanges keep busy */
    MOST_OWED_NS = 50000000   /* of that, where there was nothing to poll */
};
static const int64_t RETRY_WRITE_NS = 1000000;

static void call(struct md_port *port)
{
    if (port->row_queue)
        md_row_queue_call(port->row_queue, port->number);
}

static void watch(struct md_port *port, int watched)
{
    if (port->watched == watched || port->progress.lost)
        return;
    md_waiter_change(port->engine->waiter, port->fd, port, watched);
    port->watched = watched;
}

static void stop_repeating(struct md_port *port)
{
    port->round_len = 0;
    md_put(&port->progress.repeating, 0);
    call(port);
}

static void lose(struct md_port *port, int error)
{
    port->lost_error = error;
    md_put(&port->progress.lost, 1);
    md_waiter_remove(port->engine->waiter, port->fd); /* a port that hung up is ready for ever */
    md_line_abandon(&port->line, MD_LINE_LOST, error);
    stop_repeating(port);
}

static int is_transient(int error)
{
    return error == EAGAIN || error == EWOULDBLOCK || error == EINTR;
}

int64_t md_port_hear(struct md_port *port)
{
    uint8_t bytes[1024];
    ssize_t got = read(port->fd, bytes, sizeof bytes);
    int64_t now_ns = md_now_ns();
    port->emptied = got < (ssize_t)sizeof bytes;
    if (got > 0)
        md_line_received(&port->line, bytes, (size_t)got, now_ns);
    else if (got == 0)
        lose(port, 0);
    else if (!is_transient(errno))
        lose(port, errno);
    return now_ns;
}

/* The port took something. The request leaves when it is written; where the thread was held up just then,
 * perhaps afterwards: since too early a time its reply, and a late one, would be waited for too short. */
static int pump_out(struct md_port *port, int64_t begun_ns)
{
    struct md_line *line = &port->line;
    ssize_t written = write(port->fd, line->tx + line->tx_at, (size_t)(line->tx_len - line->tx_at));
    int64_t done_ns = md_now_ns();
    if (written > 0)
        md_line_sent(line, (size_t)written, begun_ns, done_ns - begun_ns > HELD_UP_NS ? done_ns : begun_ns);
    else if (written < 0 && !is_transient(errno))
        lose(port, errno);
    return written != 0 && (written > 0 || port->progress.lost);
}

static int same_settings(const struct md_settings *a, const struct md_settings *b)
{
    return a->baudrate == b->baudrate && a->databits == b->databits && a->parity == b->parity &&
           a->stopbits == b->stopbits;
}

/* What time it is then. */
static int64_t apply_settings(struct md_port *port, const struct md_settings *settings, int64_t now_ns)
{
    if (port->must_take < 0 || same_settings(&port->settings, settings))
        return now_ns;
    int64_t begun_ns = md_now_ns();
    int refused = md_port_set(port->fd, settings);
    now_ns = md_now_ns();
    port->progress.switching_ns += now_ns - begun_ns;
    md_put(&port->progress.switches, port->progress.switches + 1);
    port->settings = (struct md_settings){0}; /* of those that are refused some may be in force now */
    if (refused < 0)
        lose(port, -refused);
    else if (refused & port->must_take)
        md_line_abandon(&port->line, MD_SETTINGS_REFUSED, refused);
    else
        port->settings = *settings;
    return now_ns;
}

/* Take it up, or what is to be asked before: then 0. */
static int begin(struct md_port *port, enum turn turn, const struct md_exchange *exchange,
                 struct md_completion *completion, int64_t now_ns)
{
    const struct md_exchange *first = md_before(&port->before, exchange, port->line.echo, now_ns);
    port->turn = first ? BEFORE : turn;
    md_line_begin(&port->line, first ? first : exchange, first ? &port->completion : completion, now_ns);
    if (port->progress.lost)
        md_line_abandon(&port->line, MD_LINE_LOST, port->lost_error);
    return !first;
}

static unsigned pending(struct md_port *port)
{
    return md_get(&port->progress.submitted) - port->progress.done;
}

/* Whether the line is so late that the same exchange's next slot is due already: none is made up for. */
static int is_over(struct md_port *port, const struct slot *slot, int64_t now_ns)
{
    int64_t period_ns = slot->exchange->period_ns;
    if (!period_ns || now_ns < slot->not_before_ns + period_ns)
        return 0;
    uint32_t submitted = md_get(&port->progress.submitted);
    for (uint32_t at = port->progress.done + 1; at != submitted; at++) {
        const struct slot *next = &port->slots[at & (port->room - 1)];
        if (next->exchange == slot->exchange)
            return now_ns >= next->not_before_ns;
    }
    return 0;
}

/* Take up what is queued, or say when; whether there is anything to carry out now. */
static int take_from_queue(struct md_port *port, int64_t *wake_ns, int64_t now_ns)
{
    const struct slot *slot = &port->slots[port->progress.done & (port->room - 1)];
    if (now_ns >= slot->not_before_ns) {
        if (begin(port, QUEUED, slot->exchange, &port->completion, now_ns) && is_over(port, slot, now_ns))
            md_line_abandon(&port->line, MD_EXPIRED, 0);
        return 1;
    }
    if (slot->not_before_ns < *wake_ns)
        *wake_ns = slot->not_before_ns;
    return 0;
}

/* To the next one of those that are repeated. With many lines what it and those behind it need is out
 * of the caches by now, and is fetched while there is time. */
static void move_on(struct md_port *port)
{
    unsigned second = port->round_at + 1 < port->round_len ? port->round_at + 1 : 0;
    unsigned third = second + 1 < port->round_len ? second + 1 : 0;
    port->round_at = second;
    const struct md_exchange *soon = port->round[second];
    __builtin_prefetch(port->round[third]);
    __builtin_prefetch(&port->round[third]->request);
    __builtin_prefetch(soon->block);
    __builtin_prefetch(soon->drive);
    __builtin_prefetch(&soon->drive->counters);
}

/* Whether nobody wants any more what is under way, and nothing of it has left. */
static int is_expired(const struct md_port *port, int64_t now_ns)
{
    if (port->turn != WISHED || port->line.tx_at > 0)
        return 0;
    const struct wish *wish = port->wishes;
    int is_overtaken = wish->exchange->stops && md_get(wish->exchange->stops) != wish->exchange->stops_seen;
    return is_overtaken || (wish->expires_ns && now_ns > wish->expires_ns);
}

/* Count what an exchange took of the line. */
static void settle(struct md_port *port, int64_t took_ns)
{
    if (port->turn == WISHED)
        port->owed_ns += took_ns / (POLLED - 1);
    else if ((port->turn == QUEUED || port->turn == REPEATED) && port->owed_ns > 0)
        port->owed_ns -= took_ns;
    if (port->owed_ns > MOST_OWED_NS)
        port->owed_ns = MOST_OWED_NS;
}

/* One exchange of what is polled may hold up the wishes: never two in a row, and never a stop. */
static int is_owed(const struct md_port *port)
{
    for (const struct wish *wish = port->wishes; wish; wish = wish->next)
        if (wish->exchange->insists)
            return 0;
    return port->owed_ns > 0 && port->last_turn == WISHED;
}

static void grant(struct md_port *port, struct wish *wish, int64_t now_ns)
{
    if (begin(port, WISHED, wish->exchange, wish->completion, now_ns) && is_expired(port, now_ns))
        md_line_abandon(&port->line, MD_EXPIRED, 0);
}

/* Take up what is queued and due, or else repeated; 0 where there is none. */
static int take_polled(struct md_port *port, int64_t *wake_ns, int64_t now_ns)
{
    if (port->ending)
        return 0;
    if (pending(port) && take_from_queue(port, wake_ns, now_ns))
        return 1;
    if (!port->round_len)
        return 0;
    if (begin(port, REPEATED, port->round[port->round_at], &port->completion, now_ns))
        move_on(port);
    return 1;
}

/* Take up what is to be done next, or say when; whether there is anything to carry out now. */
static int take_up(struct md_port *port, int64_t *wake_ns, int64_t now_ns)
{
    struct wish *wish = port->wishes;
    int is_wished = wish && now_ns >= wish->not_before_ns;
    *wake_ns = wish ? wish->not_before_ns : MD_NEVER;
    if ((!is_wished || is_owed(port)) && take_polled(port, wake_ns, now_ns))
        return 1;
    if (is_wished) {
        grant(port, wish, now_ns);
        return 1;
    }
    if (!port->ending && !pending(port)) {
        atomic_store(&port->idle, 1);
        if (pending(port)) /* it came just now */
            *wake_ns = now_ns;
    }
    return 0;
}

/* Hand over what became of an exchange that nobody waits for. */
static void report(struct md_port *port)
{
    const struct md_exchange *exchange = port->line.exchange;
    const struct md_completion *completion = &port->completion;
    if (port->row_queue)
        md_row_queue_add(port->row_queue, exchange->block, completion);
    int is_refusal = completion->result > 0 && completion->reply.exception;
    if (is_refusal || exchange->drive->failures != port->before.failures)
        call(port);
}

void md_port_finish(struct md_port *port)
{
    enum turn turn = port->turn;
    port->last_turn = turn;
    port->turn = NOBODYS;
    if (port->progress.echo != (uint32_t)port->line.echo)
        md_put(&port->progress.echo, (uint32_t)port->line.echo);
    if (turn == BEFORE)
        return;
    int goes_on = !port->progress.lost && (turn == WISHED || !port->ending);
    if (md_is_asked_again(&port->before, port->line.exchange, port->line.completion) && goes_on) {
        if (turn == REPEATED && port->round_len)
            port->round_at = (port->round_at ? port->round_at : port->round_len) - 1;
        return;
    }
    if (turn == WISHED) {
        struct wish *wish = port->wishes;
        port->wishes = wish->next;
        wish->done = 1;
        pthread_cond_broadcast(&port->engine->changed);
        return;
    }
    report(port);
    if (turn == QUEUED) {
        md_put(&port->progress.done, port->progress.done + 1);
        unsigned left = pending(port);
        if (left == port->room / 4 || left == 0)
            call(port);
    } else if (port->completion.result < 0 && !port->completion.sent_ns) {
        stop_repeating(port); /* it would be tried again at once */
    }
}

/* The request is out: what is waited for is its reply. */
static int is_asked(const struct md_port *port)
{
    return port->turn != NOBODYS && port->line.completion->sent_ns;
}

/* A sleeping processor wakes late, and by much the same time again and again: where requests must leave
 * in time the sleep is shortened by what is usual, and what is then too early is spun away, with few
 * lines some 20 us of each exchange. Nothing is spun away before a look at a reply, which may be early. */
static int spin_until(struct md_port *port, int64_t until_ns, int64_t *now_ns)
{
    if (until_ns - *now_ns > MD_MOST_LATENESS || port->engine->count > MOST_SPINNING || port->progress.lost)
        return 0;
    if (!port->emptied) /* what came meanwhile is looked for now, not when the request must leave */
        *now_ns = md_port_hear(port);
    while (*now_ns < until_ns)
        *now_ns = md_now_ns();
    return 1;
}

int64_t md_port_advance(struct md_port *port, int64_t now_ns)
{
    struct md_line *line = &port->line;
    int64_t wake_ns;
    for (;;) {
        if (port->turn == NOBODYS && !take_up(port, &wake_ns, now_ns)) {
            if (spin_until(port, wake_ns, &now_ns))
                continue;
            break;
        }
        int want = md_line_want(line, now_ns);
        if (want == MD_DONE) {
            settle(port, now_ns - line->completion->begun_ns);
            md_port_finish(port);
            continue;
        }
        wake_ns = line->wake_ns;
        if (want == MD_WRITE && is_expired(port, now_ns)) {
            md_line_abandon(line, MD_EXPIRED, 0);
            continue;
        }
        if (want == MD_WRITE) {
            now_ns = apply_settings(port, &line->exchange->settings, now_ns);
            if (md_line_want(line, now_ns) != MD_WRITE || is_expired(port, now_ns) || pump_out(port, now_ns))
                continue;
            wake_ns = now_ns + RETRY_WRITE_NS;
            break;
        }
        if (want == MD_READ && (port->blind || now_ns >= wake_ns)) {
            port->blind = 0;
            if (!port->emptied)
                now_ns = md_port_hear(port);
            continue;
        }
        if (want == MD_WAIT && !is_asked(port) && spin_until(port, wake_ns, &now_ns))
            continue;
        port->blind = want == MD_WAIT;
        break;
    }
    port->emptied = 0;
    if (port->blind && wake_ns - now_ns > WORTH_BLINDNESS)
        watch(port, 0);
    else if (!port->blind)
        watch(port, 1);
    int is_early = wake_ns != MD_NEVER && (port->blind || port->turn == NOBODYS) &&
                   (is_asked(port) || port->engine->count <= MOST_SPINNING);
    port->engine->wakes[port->index] = wake_ns - (is_early ? port->engine->lateness_ns : 0);
    return now_ns;
}
