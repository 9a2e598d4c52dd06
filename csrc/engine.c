/* The thread that runs every line of the process, and what its clients may do. It never takes the
 * interpreter lock.
 *
 * Exchanges come to a port through a ring, or stay with it and are repeated. An urgent exchange goes
 * ahead of all, and whoever wants it waits for it. So a line that is polled as fast as it allows needs
 * nobody but this thread. */
#define _GNU_SOURCE
#include "engine.h"

#include <errno.h>
#include <sched.h>
#include <stdlib.h>
#ifdef __linux__
#include <sys/prctl.h>
#endif

enum { READY = 256 }; /* ports that are dealt with at a time */

/* ---- the thread ---- */

static int64_t earliest(const struct md_engine *engine)
{
    int64_t least = MD_NEVER;
    for (unsigned i = 0; i < engine->count; i++)
        if (engine->wakes[i] < least)
            least = engine->wakes[i];
    return least;
}

static int wait_until(struct md_engine *engine, void **ready, int64_t until_ns)
{
    if (until_ns == MD_NEVER)
        return md_waiter_wait(engine->waiter, ready, READY, -1);
    int64_t left = until_ns - md_now_ns();
    int n = md_waiter_wait(engine->waiter, ready, READY, left > 0 ? left : 0);
    if (n > 0)
        return n;
    int64_t late = md_now_ns() - until_ns;
    if (left > 0 && late >= 0) { /* else it could not sleep for so short a time */
        if (late > MD_MOST_LATENESS)
            late = MD_MOST_LATENESS;
        engine->lateness_ns += (late - engine->lateness_ns) / (late > engine->lateness_ns ? 4 : 16);
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
        engine->wakes[engine->count] = MD_NEVER;
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
        if (port->turn == WISHED || (port->ending && port->turn != NOBODYS)) {
            /* its client is told whether it had begun to leave */
            md_line_abandon(&port->line, port->turn == WISHED ? MD_LINE_LOST : MD_POLL_ENDED, 0);
            md_port_finish(port);
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
    for (;;) {
        int64_t until_ns = earliest(engine);
        pthread_mutex_unlock(&engine->mutex);
        while (atomic_load(&engine->callers)) /* a mutex is had by who asks first, and that is us */
            sched_yield();
        int n = wait_until(engine, ready, until_ns);
        pthread_mutex_lock(&engine->mutex);
        int told = 0;
        int64_t now_ns = 0;
        for (int i = 0; i < n; i++) {
            struct md_port *port = ready[i];
            if (port)
                now_ns = md_port_advance(port, md_port_hear(port));
            else
                told = 1;
        }
        if (told) {
            md_wakeup_silence(&engine->wakeup);
            open_ports(engine);
            close_ports(engine);
        }
        if (!now_ns)
            now_ns = md_now_ns();
        for (unsigned i = 0; i < engine->count; i++)
            if (engine->wakes[i] <= now_ns || (told && engine->ports[i]->turn == NOBODYS))
                md_port_advance(engine->ports[i], md_now_ns());
    }
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
    if (engine->waiter && md_wakeup_make(&engine->wakeup) == 0) {
        if (md_waiter_add(engine->waiter, engine->wakeup.fd, NULL) == 0 &&
            pthread_create(&engine->thread, NULL, run, engine) == 0)
            return engine;
        md_wakeup_destroy(&engine->wakeup);
    }
    if (engine->waiter)
        md_waiter_free(engine->waiter);
    pthread_mutex_destroy(&engine->mutex);
    pthread_cond_destroy(&engine->changed);
    free(engine);
    return NULL;
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
    md_wakeup_ring(&engine->wakeup);
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

void md_port_tell_echo(struct md_port *port, int echo)
{
    enter(port->engine);
    port->line.echo = echo;
    port->line.echo_is_told = echo == MD_ECHO; /* an echo that shows is believed: it confirms no write */
    md_put(&port->progress.echo, (uint32_t)echo);
    leave(port->engine);
}

void md_port_inherit(struct md_port *port, struct md_drive *drive, const struct md_drive *before)
{
    enter(port->engine);
    md_late_inherit(drive, before);
    leave(port->engine);
}

void md_port_stop(struct md_port *port)
{
    struct md_engine *engine = port->engine;
    enter(engine);
    port->closing = 1;
    md_wakeup_ring(&engine->wakeup);
    while (!port->closed)
        pthread_cond_wait(&engine->changed, &engine->mutex);
    leave(engine);
}

void md_port_free(struct md_port *port)
{
    free(port->slots);
    free(port);
}

void md_port_report(struct md_port *port, struct md_row_queue *row_queue, uint32_t number)
{
    enter(port->engine);
    port->row_queue = row_queue;
    port->number = number;
    leave(port->engine);
}

int md_port_submit(struct md_port *port, const struct md_exchange *const *exchanges, const int64_t *not_before_ns, int n)
{
    unsigned submitted = port->progress.submitted;
    unsigned free_slots = port->room - (submitted - md_get(&port->progress.done));
    int taken = 0;
    for (; taken < n && (unsigned)taken < free_slots; taken++) {
        struct slot *slot = &port->slots[(submitted + (unsigned)taken) & (port->room - 1)];
        slot->exchange = exchanges[taken];
        slot->not_before_ns = not_before_ns[taken];
    }
    md_put(&port->progress.submitted, submitted + (unsigned)taken);
    if (taken && atomic_exchange(&port->idle, 0))
        md_wakeup_ring(&port->engine->wakeup);
    return taken;
}

unsigned md_port_repeat(struct md_port *port, const struct md_exchange *const *exchanges, unsigned n)
{
    enter(port->engine);
    unsigned next = port->round_at;
    port->round = exchanges;
    port->round_len = port->progress.lost ? 0 : n;
    port->round_at = 0;
    md_put(&port->progress.repeating, port->round_len > 0);
    leave(port->engine);
    md_wakeup_ring(&port->engine->wakeup);
    return next;
}

const struct md_progress *md_port_progress(struct md_port *port)
{
    return &port->progress;
}

void md_count_stop(uint32_t *stops)
{
    __atomic_fetch_add(stops, 1, __ATOMIC_SEQ_CST);
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
        struct wish **at = &port->wishes;
        if (*at && port->turn == WISHED) /* it is under way */
            at = &(*at)->next;
        for (struct wish **it = at; *it; it = &(*it)->next)
            if (!exchange->insists || (*it)->exchange->insists) /* that one came first, and goes first */
                at = &(*it)->next;
        wish.next = *at;
        *at = &wish;
        md_wakeup_ring(&engine->wakeup);
    }
    while (!wish.done)
        pthread_cond_wait(&engine->changed, &engine->mutex);
    leave(engine);
}
