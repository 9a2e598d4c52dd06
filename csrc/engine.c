/* The thread that runs every line of the process. It never takes the interpreter lock.
 *
 * Exchanges come to a port through a ring, are carried out in its slots, and are reaped from them:
 * each of the ring's counters has one writer, and nothing is copied. An urgent exchange goes ahead
 * of the ring, and whoever wants it waits for it. */
#define _GNU_SOURCE
#include "multidrop.h"

#include <errno.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/prctl.h>
#include <time.h>
#include <unistd.h>

enum {
    EVENTS = 256,           /* taken from epoll at a time */
    WORTH_BLINDNESS = 200000, /* ns; a shorter wait is not worth the system calls to look away */
    MOST_LATENESS = 60000     /* ns of a wake-up that are reckoned with */
};
static const int64_t NEVER = INT64_MAX;
static const int64_t RETRY_WRITE_NS = 1000000;

struct slot {
    const struct md_exchange *exchange;
    int64_t not_before_ns;
    struct md_completion completion;
};

/* An urgent exchange; it lives where its caller waits. */
struct wish {
    const struct md_exchange *exchange;
    int64_t not_before_ns, expires_ns;
    struct md_completion *completion;
    struct wish *next;
    int done;
};

struct md_port {
    struct md_engine *engine;
    unsigned index; /* among the engine's ports */
    int fd, must_take;
    struct md_settings settings; /* in force; baudrate 0: not yet set */
    struct md_line line;

    struct slot *slots;
    unsigned room; /* a power of two */
    struct md_progress progress; /* its counters have one writer each, and are read atomically */
    atomic_int idle;    /* the thread waits to be told of more */
    struct wish *wishes;

    struct slot *slot; /* under way, or */
    struct wish *wish; /* under way */
    int blind;         /* nothing is worth reading before the port's waking time */
    int watched;       /* epoll tells when it can be read */
    int emptied;       /* it was read empty a moment ago: nothing is there yet */
    int lost_error;
    int ending, closing, closed;
};

struct md_engine {
    pthread_t thread;
    pthread_mutex_t mutex;  /* held by the thread but while it waits; guards all below, and the wishes */
    pthread_cond_t changed; /* a wish was granted, a port closed */
    int epoll, bell, notice;
    struct md_port **ports;
    int64_t *wakes; /* when each port wants to be looked at, whatever happens */
    unsigned count, room;
    int64_t lateness_ns; /* of the thread's waking, as is usual */
    int stopping;
};

int64_t md_now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

static uint32_t get(const uint32_t *counter)
{
    return __atomic_load_n(counter, __ATOMIC_SEQ_CST);
}

static void put(uint32_t *counter, uint32_t value)
{
    __atomic_store_n(counter, value, __ATOMIC_SEQ_CST);
}

static void ring(int eventfd)
{
    uint64_t one = 1;
    (void)!write(eventfd, &one, sizeof one);
}

static void silence(int eventfd)
{
    uint64_t count;
    (void)!read(eventfd, &count, sizeof count);
}

/* ---- one port, on the engine's thread ---- */

static void watch(struct md_port *port, int watched)
{
    if (port->watched == watched || port->progress.lost)
        return;
    struct epoll_event event = {.events = watched ? EPOLLIN : 0, .data.ptr = port};
    epoll_ctl(port->engine->epoll, EPOLL_CTL_MOD, port->fd, &event);
    port->watched = watched;
}

static void lose(struct md_port *port, int error)
{
    port->lost_error = error;
    put(&port->progress.lost, 1);
    epoll_ctl(port->engine->epoll, EPOLL_CTL_DEL, port->fd, NULL); /* a port that hung up is ready for ever */
    md_line_abandon(&port->line, MD_LINE_LOST, error);
}

static int is_transient(int error)
{
    return error == EAGAIN || error == EWOULDBLOCK || error == EINTR;
}

static void pump_in(struct md_port *port)
{
    uint8_t bytes[1024];
    ssize_t got = read(port->fd, bytes, sizeof bytes);
    port->emptied = got < (ssize_t)sizeof bytes;
    if (got > 0)
        md_line_received(&port->line, bytes, (size_t)got, md_now_ns());
    else if (got == 0)
        lose(port, 0);
    else if (!is_transient(errno))
        lose(port, errno);
}

/* Whether the port took anything. */
static int pump_out(struct md_port *port, int64_t now_ns)
{
    struct md_line *line = &port->line;
    ssize_t written = write(port->fd, line->tx + line->tx_at, (size_t)(line->tx_len - line->tx_at));
    if (written > 0)
        md_line_sent(line, (size_t)written, now_ns);
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
    int refused = md_port_set(port->fd, settings);
    if (refused < 0)
        lose(port, -refused);
    else if (refused & port->must_take)
        md_line_abandon(&port->line, MD_SETTINGS_REFUSED, refused);
    else
        port->settings = *settings;
}

static void begin(struct md_port *port, const struct md_exchange *exchange, struct md_completion *completion, int64_t now_ns)
{
    md_line_begin(&port->line, exchange, completion, now_ns);
    if (port->progress.lost)
        md_line_abandon(&port->line, MD_LINE_LOST, port->lost_error);
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

/* Take up what is to be done next, or say when; whether there is anything to carry out now. */
static int take_up(struct md_port *port, int64_t *wake_ns, int64_t now_ns)
{
    struct wish *wish = port->wishes;
    if (wish && now_ns >= wish->not_before_ns) {
        port->wish = wish;
        begin(port, wish->exchange, wish->completion, now_ns);
        if (wish->expires_ns && now_ns > wish->expires_ns)
            md_line_abandon(&port->line, MD_EXPIRED, 0);
        return 1;
    }
    if (wish)
        *wake_ns = wish->not_before_ns;
    if (port->ending)
        return 0;
    if (!pending(port)) {
        atomic_store(&port->idle, 1);
        if (!pending(port))
            return 0;
        atomic_store(&port->idle, 0);
    }
    struct slot *slot = &port->slots[port->progress.done & (port->room - 1)];
    if (now_ns < slot->not_before_ns) {
        if (slot->not_before_ns < *wake_ns)
            *wake_ns = slot->not_before_ns;
        return 0;
    }
    port->slot = slot;
    begin(port, slot->exchange, &slot->completion, now_ns);
    if (is_over(port, slot, now_ns))
        md_line_abandon(&port->line, MD_EXPIRED, 0);
    return 1;
}

static void finish(struct md_port *port)
{
    if (port->wish) {
        port->wishes = port->wish->next;
        port->wish->done = 1;
        port->wish = NULL;
        pthread_cond_broadcast(&port->engine->changed);
        return;
    }
    port->slot = NULL;
    put(&port->progress.done, port->progress.done + 1);
    unsigned left = pending(port);
    if (left == port->room / 4 || left == 0)
        ring(port->engine->notice);
}

/* Carry on until there is nothing to do but to wait. */
static void advance(struct md_port *port)
{
    struct md_line *line = &port->line;
    int64_t wake_ns = NEVER;
    for (;;) {
        int64_t now_ns = md_now_ns();
        if (!port->slot && !port->wish && !take_up(port, &wake_ns, now_ns))
            break;
        int want = md_line_want(line, now_ns);
        if (want == MD_DONE) {
            finish(port);
            continue;
        }
        wake_ns = line->wake_ns;
        if (want == MD_WRITE) {
            apply_settings(port, &line->exchange->settings);
            if (md_line_want(line, now_ns) != MD_WRITE || pump_out(port, md_now_ns()))
                continue;
            wake_ns = now_ns + RETRY_WRITE_NS;
            break;
        }
        if (want == MD_READ && (port->blind || now_ns >= wake_ns)) {
            port->blind = 0;
            if (!port->emptied)
                pump_in(port);
            continue;
        }
        port->blind = want == MD_WAIT;
        break;
    }
    port->emptied = 0;
    if (port->blind && wake_ns - md_now_ns() > WORTH_BLINDNESS)
        watch(port, 0);
    else if (!port->blind)
        watch(port, 1);
    port->engine->wakes[port->index] = wake_ns;
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

/* Sleeping processors wake late, and by much the same time again and again: the sleep is shortened
 * by what is usual, and what is then too early is spun away. */
static int wait_for_events(struct md_engine *engine, struct epoll_event *events, int64_t until_ns)
{
    if (until_ns == NEVER)
        return epoll_pwait2(engine->epoll, events, EVENTS, NULL, NULL);
    int64_t left = until_ns - engine->lateness_ns - md_now_ns();
    struct timespec span = {.tv_sec = left / 1000000000, .tv_nsec = left % 1000000000};
    if (left <= 0)
        span = (struct timespec){0};
    int n = epoll_pwait2(engine->epoll, events, EVENTS, &span, NULL);
    if (n == 0 && left > 0) {
        int64_t late = md_now_ns() - (until_ns - engine->lateness_ns);
        engine->lateness_ns += (late - engine->lateness_ns) / 8;
        if (engine->lateness_ns > MOST_LATENESS)
            engine->lateness_ns = MOST_LATENESS;
        while (md_now_ns() < until_ns)
            ;
    }
    return n;
}

/* Close those ports whose clients wait for it; nobody is on them now. */
static void close_ports(struct md_engine *engine)
{
    for (unsigned i = engine->count; i-- > 0;) {
        struct md_port *port = engine->ports[i];
        if (!port->closing)
            continue;
        if (!port->progress.lost)
            epoll_ctl(engine->epoll, EPOLL_CTL_DEL, port->fd, NULL);
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
    struct epoll_event events[EVENTS];
#ifdef __linux__
    prctl(PR_SET_TIMERSLACK, 1UL, 0UL, 0UL, 0UL); /* the default is 50 us */
#endif
    pthread_mutex_lock(&engine->mutex);
    while (!engine->stopping) {
        int64_t until_ns = earliest(engine);
        pthread_mutex_unlock(&engine->mutex);
        int n = wait_for_events(engine, events, until_ns);
        pthread_mutex_lock(&engine->mutex);
        int told = 0;
        for (int i = 0; i < n; i++) {
            struct md_port *port = events[i].data.ptr;
            if (!port) {
                told = 1;
                continue;
            }
            pump_in(port);
            advance(port);
        }
        if (told) {
            silence(engine->bell);
            close_ports(engine);
        }
        int64_t now_ns = md_now_ns();
        for (unsigned i = 0; i < engine->count; i++)
            if (engine->wakes[i] <= now_ns || (told && !engine->ports[i]->slot && !engine->ports[i]->wish))
                advance(engine->ports[i]);
    }
    pthread_mutex_unlock(&engine->mutex);
    return NULL;
}

/* ---- the client's side ---- */

static void release(struct md_engine *engine)
{
    int fds[] = {engine->epoll, engine->bell, engine->notice};
    for (int i = 0; i < 3; i++)
        if (fds[i] >= 0)
            close(fds[i]);
    pthread_mutex_destroy(&engine->mutex);
    pthread_cond_destroy(&engine->changed);
    free(engine->ports);
    free(engine->wakes);
    free(engine);
}

struct md_engine *md_engine_start(void)
{
    struct md_engine *engine = calloc(1, sizeof *engine);
    if (!engine)
        return NULL;
    pthread_mutex_init(&engine->mutex, NULL);
    pthread_cond_init(&engine->changed, NULL);
    engine->epoll = epoll_create1(EPOLL_CLOEXEC);
    engine->bell = eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC);
    engine->notice = eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC);
    struct epoll_event event = {.events = EPOLLIN, .data.ptr = NULL};
    if (engine->epoll >= 0 && engine->bell >= 0 && engine->notice >= 0 &&
        epoll_ctl(engine->epoll, EPOLL_CTL_ADD, engine->bell, &event) == 0 &&
        pthread_create(&engine->thread, NULL, run, engine) == 0)
        return engine;
    release(engine);
    return NULL;
}

void md_engine_stop(struct md_engine *engine)
{
    pthread_mutex_lock(&engine->mutex);
    engine->stopping = 1;
    pthread_mutex_unlock(&engine->mutex);
    ring(engine->bell);
    pthread_join(engine->thread, NULL);
    release(engine);
}

int md_engine_notice(struct md_engine *engine)
{
    return engine->notice;
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
    *port = (struct md_port){.engine = engine, .fd = fd, .must_take = must_take, .slots = slots, .room = room, .idle = 1, .watched = 1};
    md_line_init(&port->line, md_now_ns());
    /* Raw before it is first read: a terminal at VMIN 0 looks like one that hung up. */
    struct md_settings settings;
    if (must_take >= 0 && md_port_get(fd, &settings) == 0)
        md_port_set(fd, &settings);
    struct epoll_event event = {.events = EPOLLIN, .data.ptr = port};
    pthread_mutex_lock(&engine->mutex);
    int added = grow(engine) && epoll_ctl(engine->epoll, EPOLL_CTL_ADD, fd, &event) == 0;
    if (added) {
        port->index = engine->count;
        engine->wakes[engine->count] = NEVER;
        engine->ports[engine->count++] = port;
    }
    pthread_mutex_unlock(&engine->mutex);
    if (added)
        return port;
    free(slots);
    free(port);
    return NULL;
}

int md_port_end(struct md_port *port)
{
    pthread_mutex_lock(&port->engine->mutex);
    port->ending = 1;
    int is_under_way = port->slot != NULL;
    pthread_mutex_unlock(&port->engine->mutex);
    return is_under_way;
}

void md_port_tap(struct md_port *port, struct md_tap *tap)
{
    pthread_mutex_lock(&port->engine->mutex);
    port->line.tap = tap;
    pthread_mutex_unlock(&port->engine->mutex);
}

void md_port_stop(struct md_port *port)
{
    struct md_engine *engine = port->engine;
    pthread_mutex_lock(&engine->mutex);
    port->closing = 1;
    ring(engine->bell);
    while (!port->closed)
        pthread_cond_wait(&engine->changed, &engine->mutex);
    pthread_mutex_unlock(&engine->mutex);
}

void md_port_free(struct md_port *port)
{
    free(port->slots);
    free(port);
}

int md_port_submit(struct md_port *port, const struct md_exchange *const *exchanges, const int64_t *not_before_ns, int n)
{
    unsigned submitted = port->progress.submitted;
    unsigned free_slots = port->room - (submitted - port->progress.reaped);
    int taken = 0;
    for (; taken < n && (unsigned)taken < free_slots; taken++) {
        struct slot *slot = &port->slots[(submitted + (unsigned)taken) & (port->room - 1)];
        slot->exchange = exchanges[taken];
        slot->not_before_ns = not_before_ns[taken];
    }
    put(&port->progress.submitted, submitted + (unsigned)taken);
    if (taken && atomic_exchange(&port->idle, 0))
        ring(port->engine->bell);
    return taken;
}

const struct md_progress *md_port_progress(struct md_port *port)
{
    return &port->progress;
}

int md_port_reap(struct md_port *port, struct md_columns *columns, int64_t utc_minus_monotonic_ns)
{
    unsigned reaped = port->progress.reaped, done = get(&port->progress.done);
    int count = 0;
    for (; reaped != done; reaped++, count++) {
        const struct slot *slot = &port->slots[reaped & (port->room - 1)];
        const struct md_completion *completion = &slot->completion;
        struct md_block *block = slot->exchange->block;
        if (md_columns_add(columns, block, completion, utc_minus_monotonic_ns) == 0)
            break;
        if (completion->result > 0)
            block->refusals = completion->reply.exception ? block->refusals + 1 : 0;
    }
    put(&port->progress.reaped, reaped);
    return count;
}

void md_port_carry_out(struct md_port *port, const struct md_exchange *exchange, int64_t not_before_ns,
                       int64_t expires_ns, struct md_completion *completion)
{
    struct md_engine *engine = port->engine;
    struct wish wish = {.exchange = exchange, .not_before_ns = not_before_ns, .expires_ns = expires_ns, .completion = completion};
    pthread_mutex_lock(&engine->mutex);
    if (port->closing) { /* nobody would grant it any more */
        *completion = (struct md_completion){.result = MD_LINE_LOST};
        wish.done = 1;
    } else {
        struct wish **last = &port->wishes;
        while (*last)
            last = &(*last)->next;
        *last = &wish;
        ring(engine->bell);
    }
    while (!wish.done)
        pthread_cond_wait(&engine->changed, &engine->mutex);
    pthread_mutex_unlock(&engine->mutex);
}
