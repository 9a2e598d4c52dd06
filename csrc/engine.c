/* The thread that runs every line of the process. It never takes the interpreter lock.
 *
 * Exchanges come to a port through a ring, or stay with it and are repeated; what became of them goes
 * to the client's inbox. An urgent exchange goes ahead of all, and whoever wants it waits for it. So a
 * line that is polled as fast as it allows needs nobody but this thread. */
#define _GNU_SOURCE
#include "multidrop.h"
#include "waiter.h"

#include <errno.h>
#include <pthread.h>
#include <sched.h>
#include <stdatomic.h>
#include <stdlib.h>
#ifdef __linux__
#include <sys/prctl.h>
#endif
#include <unistd.h>

enum {
    READY = 256,              /* ports that are dealt with at a time */
    WORTH_BLINDNESS = 200000, /* ns; a shorter wait is not worth the system calls to look away */
    MOST_LATENESS = 80000,    /* ns of a wake-up that are reckoned with */
    HELD_UP_NS = 200000,      /* no write takes so long by itself */
    MOST_SPINNING = 4         /* ports; with more of them the processor has better to do */
};
static const int64_t NEVER = INT64_MAX;
static const int64_t RETRY_WRITE_NS = 1000000;

/* An exchange that is queued. */
struct slot {
    const struct md_exchange *exchange;
    int64_t not_before_ns;
};

/* An urgent exchange; it lives where its caller waits. */
struct wish {
    const struct md_exchange *exchange;
    int64_t not_before_ns, expires_ns;
    struct md_completion *completion;
    struct wish *next;
    int done;
};

/* Whose exchange is under way. */
enum turn { NOBODYS, TELLERS, WISHED, QUEUED, REPEATED };

struct md_port {
    struct md_engine *engine;
    unsigned index; /* among the engine's ports */
    int fd, must_take;
    struct md_settings settings; /* in force; baudrate 0: not yet set */

    struct slot *slots;
    unsigned room; /* a power of two */
    struct md_progress progress; /* its counters have one writer each, and are read atomically */
    atomic_int idle;    /* the thread waits to be told of more */
    struct wish *wishes;
    const struct md_exchange *const *round; /* what is repeated */
    unsigned round_len, round_at;
    struct md_inbox *inbox;
    uint32_t number; /* there */

    enum turn turn;
    const struct md_exchange *told; /* before this one its teller has had its turn */
    uint32_t failures; /* of the drive, before its exchange */
    int blind;         /* nothing is worth reading before the port's waking time */
    int watched;       /* the waiter tells when it can be read */
    int emptied;       /* it was read empty a moment ago: nothing is there yet */
    int lost_error;
    struct md_port *next; /* of those that wait to be opened */
    int opened, open_error;
    int ending, closing, closed;
    struct md_line line;
    struct md_completion completion;
};

struct md_engine {
    pthread_t thread;
    pthread_mutex_t mutex;  /* held by the thread but while it waits; guards all below, and the wishes */
    atomic_int callers;     /* clients that want the mutex, whom the thread lets in */
    pthread_cond_t changed; /* a wish was granted, a port opened or closed */
    struct md_waiter *waiter;
    struct md_bell bell;
    struct md_port *arriving; /* clients wait for these to be opened */
    struct md_port **ports;
    int64_t *wakes; /* when the thread is to wake for each port, whatever happens */
    unsigned count, room;
    int64_t lateness_ns; /* of the thread's waking, as is usual */
    int stopping;
};

static uint32_t get(const uint32_t *counter)
{
    return __atomic_load_n(counter, __ATOMIC_SEQ_CST);
}

static void put(uint32_t *counter, uint32_t value)
{
    __atomic_store_n(counter, value, __ATOMIC_SEQ_CST);
}

/* ---- one port, on the engine's thread ---- */

static void call(struct md_port *port)
{
    if (port->inbox)
        md_inbox_call(port->inbox, port->number);
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
    put(&port->progress.repeating, 0);
    call(port);
}

static void lose(struct md_port *port, int error)
{
    port->lost_error = error;
    put(&port->progress.lost, 1);
    md_waiter_remove(port->engine->waiter, port->fd); /* a port that hung up is ready for ever */
    md_line_abandon(&port->line, MD_LINE_LOST, error);
    stop_repeating(port);
}

static int is_transient(int error)
{
    return error == EAGAIN || error == EWOULDBLOCK || error == EINTR;
}

/* When it was read. */
static int64_t pump_in(struct md_port *port)
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

/* Whether the port took anything. The request leaves when it is written; where the thread was held up
 * just then, afterwards: since too early a time its reply, and a late one, would be waited for too short. */
static int pump_out(struct md_port *port, int64_t begun_ns)
{
    struct md_line *line = &port->line;
    ssize_t written = write(port->fd, line->tx + line->tx_at, (size_t)(line->tx_len - line->tx_at));
    int64_t done_ns = md_now_ns();
    if (written > 0)
        md_line_sent(line, (size_t)written, done_ns - begun_ns > HELD_UP_NS ? done_ns : begun_ns);
    else if (written < 0 && !is_transient(errno))
        lose(port, errno);
    return written != 0 && (written > 0 || port->progress.lost);
}

static int same_settings(const struct md_settings *a, const struct md_settings *b)
{
    return a->baudrate == b->baudrate && a->databits == b->databits && a->parity == b->parity &&
           a->stopbits == b->stopbits;
}

static void apply_settings(struct md_port *port, const struct md_settings *settings)
{
    if (port->must_take < 0 || same_settings(&port->settings, settings))
        return;
    int64_t begun_ns = md_now_ns();
    int refused = md_port_set(port->fd, settings);
    port->progress.switching_ns += md_now_ns() - begun_ns;
    put(&port->progress.switches, port->progress.switches + 1);
    if (refused < 0)
        lose(port, -refused);
    else if (refused & port->must_take)
        md_line_abandon(&port->line, MD_SETTINGS_REFUSED, refused);
    else
        port->settings = *settings;
}

/* Whether it was begun, and not its teller. */
static int begin(struct md_port *port, enum turn turn, const struct md_exchange *exchange,
                 struct md_completion *completion, int64_t now_ns)
{
    if (exchange->teller && port->line.echo == MD_ECHO_UNKNOWN && port->told != exchange) {
        port->told = exchange;
        turn = TELLERS;
        exchange = exchange->teller;
        completion = &port->completion;
    } else {
        port->told = NULL;
    }
    port->turn = turn;
    port->failures = exchange->drive->failures;
    md_line_begin(&port->line, exchange, completion, now_ns);
    if (port->progress.lost)
        md_line_abandon(&port->line, MD_LINE_LOST, port->lost_error);
    return turn != TELLERS;
}

static unsigned pending(struct md_port *port)
{
    return get(&port->progress.submitted) - port->progress.done;
}

/* Whether the line is so late that the same exchange's next slot is due already: none is made up for. */
static int is_over(struct md_port *port, const struct slot *slot, int64_t now_ns)
{
    int64_t period_ns = slot->exchange->period_ns;
    if (!period_ns || now_ns < slot->not_before_ns + period_ns)
        return 0;
    uint32_t submitted = get(&port->progress.submitted);
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
    __builtin_prefetch(&soon->drive->tally);
}

/* Take up what is to be done next, or say when; whether there is anything to carry out now. */
static int take_up(struct md_port *port, int64_t *wake_ns, int64_t now_ns)
{
    struct wish *wish = port->wishes;
    if (wish && now_ns >= wish->not_before_ns) {
        int is_begun = begin(port, WISHED, wish->exchange, wish->completion, now_ns);
        if (is_begun && wish->expires_ns && now_ns > wish->expires_ns)
            md_line_abandon(&port->line, MD_EXPIRED, 0);
        return 1;
    }
    *wake_ns = wish ? wish->not_before_ns : NEVER;
    if (port->ending)
        return 0;
    if (pending(port) && take_from_queue(port, wake_ns, now_ns))
        return 1;
    if (port->round_len) {
        if (begin(port, REPEATED, port->round[port->round_at], &port->completion, now_ns))
            move_on(port);
        return 1;
    }
    if (!pending(port)) {
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
    if (port->inbox)
        md_inbox_add(port->inbox, exchange->block, completion);
    struct md_block *block = exchange->block;
    int is_refusal = completion->result > 0 && completion->reply.exception;
    if (block && is_refusal)
        block->refusals++;
    else if (block && completion->result > 0 && block->refusals)
        block->refusals = 0;
    if (is_refusal || exchange->drive->failures != port->failures)
        call(port);
}

static void finish(struct md_port *port)
{
    enum turn turn = port->turn;
    port->turn = NOBODYS;
    if (turn == TELLERS)
        return;
    if (turn == WISHED) {
        struct wish *wish = port->wishes;
        port->wishes = wish->next;
        wish->done = 1;
        pthread_cond_broadcast(&port->engine->changed);
        return;
    }
    report(port);
    if (turn == QUEUED) {
        put(&port->progress.done, port->progress.done + 1);
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
    if (until_ns - *now_ns > MOST_LATENESS || port->engine->count > MOST_SPINNING || port->progress.lost)
        return 0;
    if (!port->emptied) /* what came meanwhile is looked for now, not when the request must leave */
        *now_ns = pump_in(port);
    while (*now_ns < until_ns)
        *now_ns = md_now_ns();
    return 1;
}

/* Carry on until there is nothing to do but to wait. */
static void advance(struct md_port *port, int64_t now_ns)
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
            finish(port);
            continue;
        }
        wake_ns = line->wake_ns;
        if (want == MD_WRITE) {
            apply_settings(port, &line->exchange->settings);
            now_ns = md_now_ns();
            if (md_line_want(line, now_ns) != MD_WRITE || pump_out(port, now_ns))
                continue;
            wake_ns = now_ns + RETRY_WRITE_NS;
            break;
        }
        if (want == MD_READ && (port->blind || now_ns >= wake_ns)) {
            port->blind = 0;
            if (!port->emptied)
                now_ns = pump_in(port);
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
    int is_early = wake_ns != NEVER && (port->blind || port->turn == NOBODYS) &&
                   (is_asked(port) || port->engine->count <= MOST_SPINNING);
    port->engine->wakes[port->index] = wake_ns - (is_early ? port->engine->lateness_ns : 0);
}

/* ---- the thread ---- */

static int64_t earliest(const struct md_engine *engine)
{
    int64_t least = NEVER;
    for (unsigned i = 0; i < engine->count; i++)
        if (engine->wakes[i] < least)
            least = engine->wakes[i];
    return least;
}

static int wait_until(struct md_engine *engine, void **ready, int64_t until_ns)
{
    if (until_ns == NEVER)
        return md_waiter_wait(engine->waiter, ready, READY, -1);
    int64_t left = until_ns - md_now_ns();
    int n = md_waiter_wait(engine->waiter, ready, READY, left > 0 ? left : 0);
    int64_t late = md_now_ns() - until_ns;
    if (n == 0 && left > 0 && late >= 0) { /* else it could not sleep for so short a time */
        engine->lateness_ns += (late - engine->lateness_ns) / (late > engine->lateness_ns ? 4 : 16);
        if (engine->lateness_ns > MOST_LATENESS)
            engine->lateness_ns = MOST_LATENESS;
    }
    return n;
}

/* Make room for one more port; 0 when there is no memory. */
static int grow(struct md_engine *engine)
{
    if (engine->count < engine->room)
        return 1;
    unsigned room = engine->room ? 2 * engine->room : 16;
    struct md_port **ports = realloc(engine->ports, room * sizeof *ports);
    if (ports)
        engine->ports = ports;
    int64_t *wakes = realloc(engine->wakes, room * sizeof *wakes);
    if (wakes)
        engine->wakes = wakes;
    if (!ports || !wakes)
        return 0;
    engine->room = room;
    return 1;
}

/* Open those ports whose clients wait for it: nobody else may touch the waiter while it waits. */
static void open_ports(struct md_engine *engine)
{
    for (struct md_port *port = engine->arriving; port; port = port->next) {
        port->opened = 1;
        if (!grow(engine) || md_waiter_add(engine->waiter, port->fd, port)) {
            port->open_error = errno;
            continue;
        }
        port->index = engine->count;
        engine->wakes[engine->count] = NEVER;
        engine->ports[engine->count++] = port;
    }
    if (engine->arriving)
        pthread_cond_broadcast(&engine->changed);
    engine->arriving = NULL;
}

/* Close those ports whose clients wait for it; nobody is on them now. */
static void close_ports(struct md_engine *engine)
{
    for (unsigned i = engine->count; i-- > 0;) {
        struct md_port *port = engine->ports[i];
        if (!port->closing)
            continue;
        if (port->ending && port->turn != NOBODYS && port->turn != WISHED) {
            md_line_abandon(&port->line, MD_POLL_ENDED, 0);
            finish(port);
        }
        if (!port->progress.lost)
            md_waiter_remove(engine->waiter, port->fd);
        struct md_port *last = engine->ports[--engine->count];
        engine->ports[i] = last;
        engine->wakes[i] = engine->wakes[engine->count];
        last->index = i;
        for (struct wish *wish = port->wishes; wish; wish = wish->next) {
            *wish->completion = (struct md_completion){.result = MD_LINE_LOST};
            wish->done = 1;
        }
        port->closed = 1;
        pthread_cond_broadcast(&engine->changed);
    }
}

static void *run(void *argument)
{
    struct md_engine *engine = argument;
    void *ready[READY];
#ifdef __linux__
    prctl(PR_SET_TIMERSLACK, 1UL, 0UL, 0UL, 0UL); /* the default is 50 us */
#endif
    pthread_mutex_lock(&engine->mutex);
    while (!engine->stopping) {
        int64_t until_ns = earliest(engine);
        pthread_mutex_unlock(&engine->mutex);
        while (atomic_load(&engine->callers)) /* a mutex is had by who asks first, and that is us */
            sched_yield();
        int n = wait_until(engine, ready, until_ns);
        pthread_mutex_lock(&engine->mutex);
        int told = 0;
        for (int i = 0; i < n; i++) {
            struct md_port *port = ready[i];
            if (port)
                advance(port, pump_in(port));
            else
                told = 1;
        }
        if (told) {
            md_bell_silence(&engine->bell);
            open_ports(engine);
            close_ports(engine);
        }
        int64_t now_ns = md_now_ns();
        for (unsigned i = 0; i < engine->count; i++)
            if (engine->wakes[i] <= now_ns || (told && engine->ports[i]->turn == NOBODYS))
                advance(engine->ports[i], now_ns);
    }
    pthread_mutex_unlock(&engine->mutex);
    return NULL;
}

/* ---- the client's side ---- */

static void enter(struct md_engine *engine)
{
    atomic_fetch_add(&engine->callers, 1);
    pthread_mutex_lock(&engine->mutex);
    atomic_fetch_sub(&engine->callers, 1);
}

static void leave(struct md_engine *engine)
{
    pthread_mutex_unlock(&engine->mutex);
}

struct md_engine *md_engine_start(void)
{
    struct md_engine *engine = calloc(1, sizeof *engine);
    if (!engine)
        return NULL;
    pthread_mutex_init(&engine->mutex, NULL);
    pthread_cond_init(&engine->changed, NULL);
    engine->waiter = md_waiter_new();
    if (engine->waiter && md_bell_make(&engine->bell) == 0) {
        if (md_waiter_add(engine->waiter, engine->bell.fd, NULL) == 0 &&
            pthread_create(&engine->thread, NULL, run, engine) == 0)
            return engine;
        md_bell_destroy(&engine->bell);
    }
    if (engine->waiter)
        md_waiter_free(engine->waiter);
    pthread_mutex_destroy(&engine->mutex);
    pthread_cond_destroy(&engine->changed);
    free(engine);
    return NULL;
}

void md_engine_stop(struct md_engine *engine)
{
    enter(engine);
    engine->stopping = 1;
    leave(engine);
    md_bell_ring(&engine->bell);
    pthread_join(engine->thread, NULL);
    md_bell_destroy(&engine->bell);
    md_waiter_free(engine->waiter);
    pthread_mutex_destroy(&engine->mutex);
    pthread_cond_destroy(&engine->changed);
    free(engine->ports);
    free(engine->wakes);
    free(engine);
}

struct md_port *md_port_open(struct md_engine *engine, int fd, int must_take, unsigned room)
{
    struct md_port *port = calloc(1, sizeof *port);
    struct slot *slots = calloc(room, sizeof *slots);
    if (!port || !slots || room == 0 || (room & (room - 1))) {
        free(port);
        free(slots);
        errno = ENOMEM;
        return NULL;
    }
    port->engine = engine;
    port->fd = fd;
    port->must_take = must_take;
    port->slots = slots;
    port->room = room;
    port->idle = port->watched = 1;
    md_line_init(&port->line, md_now_ns());
    /* Raw before it is first read: a terminal at VMIN 0 looks like one that hung up. */
    struct md_settings settings;
    if (must_take >= 0 && md_port_get(fd, &settings) == 0)
        md_port_set(fd, &settings);
    enter(engine);
    port->next = engine->arriving;
    engine->arriving = port;
    md_bell_ring(&engine->bell);
    while (!port->opened)
        pthread_cond_wait(&engine->changed, &engine->mutex);
    leave(engine);
    if (!port->open_error)
        return port;
    errno = port->open_error;
    free(slots);
    free(port);
    return NULL;
}

int md_port_end(struct md_port *port)
{
    enter(port->engine);
    port->ending = 1;
    int is_under_way = port->turn != NOBODYS && port->turn != WISHED;
    leave(port->engine);
    return is_under_way;
}

void md_port_tap(struct md_port *port, struct md_tap *tap)
{
    enter(port->engine);
    port->line.tap = tap;
    leave(port->engine);
}

void md_port_stop(struct md_port *port)
{
    struct md_engine *engine = port->engine;
    enter(engine);
    port->closing = 1;
    md_bell_ring(&engine->bell);
    while (!port->closed)
        pthread_cond_wait(&engine->changed, &engine->mutex);
    leave(engine);
}

void md_port_free(struct md_port *port)
{
    free(port->slots);
    free(port);
}

void md_port_report(struct md_port *port, struct md_inbox *inbox, uint32_t number)
{
    enter(port->engine);
    port->inbox = inbox;
    port->number = number;
    leave(port->engine);
}

int md_port_submit(struct md_port *port, const struct md_exchange *const *exchanges, const int64_t *not_before_ns, int n)
{
    unsigned submitted = port->progress.submitted;
    unsigned free_slots = port->room - (submitted - get(&port->progress.done));
    int taken = 0;
    for (; taken < n && (unsigned)taken < free_slots; taken++) {
        struct slot *slot = &port->slots[(submitted + (unsigned)taken) & (port->room - 1)];
        slot->exchange = exchanges[taken];
        slot->not_before_ns = not_before_ns[taken];
    }
    put(&port->progress.submitted, submitted + (unsigned)taken);
    if (taken && atomic_exchange(&port->idle, 0))
        md_bell_ring(&port->engine->bell);
    return taken;
}

unsigned md_port_repeat(struct md_port *port, const struct md_exchange *const *exchanges, unsigned n)
{
    enter(port->engine);
    unsigned next = port->round_at;
    port->round = exchanges;
    port->round_len = port->progress.lost ? 0 : n;
    port->round_at = 0;
    put(&port->progress.repeating, port->round_len > 0);
    leave(port->engine);
    md_bell_ring(&port->engine->bell);
    return next;
}

const struct md_progress *md_port_progress(struct md_port *port)
{
    return &port->progress;
}

void md_port_carry_out(struct md_port *port, const struct md_exchange *exchange, int64_t not_before_ns,
                       int64_t expires_ns, struct md_completion *completion)
{
    struct md_engine *engine = port->engine;
    struct wish wish = {.exchange = exchange, .not_before_ns = not_before_ns, .expires_ns = expires_ns, .completion = completion};
    enter(engine);
    if (port->closing) { /* nobody would grant it any more */
        *completion = (struct md_completion){.result = MD_LINE_LOST};
        wish.done = 1;
    } else {
        struct wish **last = &port->wishes;
        while (*last)
            last = &(*last)->next;
        *last = &wish;
        md_bell_ring(&engine->bell);
    }
    while (!wish.done)
        pthread_cond_wait(&engine->changed, &engine->mutex);
    leave(engine);
}
