/* The thread that runs every line of the process. It never takes Python's interpreter lock, so polling
 * continues whatever Python's threads do. */
#include "engine.h"

#include <sched.h>
#include <signal.h>
#include <stdlib.h>

/* ---- prefetching ---- */

/* Prefetch the memory that ports need for their next exchange while other ports are served.
 *
 * With many lines that memory has left the caches since the line's last exchange. Without prefetching, each
 * exchange waits for it a dozen times: more than a third of the core's own time with 1024 lines, a tenth with
 * 256. The first byte of each object is read, because the processor drops a prefetch if the page's address
 * translation is not cached. */

enum { CACHE_LINE = 64, STEPS_AHEAD = 4 };

static void bring(const void *from, size_t len)
{
    const char *at = from;
    (void)*(const volatile char *)at;
    for (size_t i = CACHE_LINE; i < len; i += CACHE_LINE)
        __builtin_prefetch(at + i);
    __builtin_prefetch(at + len - 1);
}

static void bring_port(const struct md_port *port)
{
    const struct md_turn *turn = &port->turn;
    bring(port, offsetof(struct md_port, turn.line.rx) + CACHE_LINE);
    bring(&turn->completion, offsetof(struct md_completion, reply.data) + CACHE_LINE);
    bring(turn->completion.raw, CACHE_LINE);
}

static void bring_exchange(const struct md_exchange *exchange)
{
    bring(exchange, offsetof(struct md_exchange, request.data));
}

static const struct md_exchange *present(const struct md_port *port)
{
    return port->turn.source != MD_NO_SOURCE ? port->turn.line.exchange : NULL;
}

/* Return the address of the pointer to the next repeated exchange; NULL: none. */
static const struct md_exchange *const *next_pointer(const struct md_port *port)
{
    const struct md_turn *turn = &port->turn;
    return turn->round_len ? &turn->round[turn->round_at] : NULL;
}

static void bring_exchanges(const struct md_port *port)
{
    if (present(port))
        bring_exchange(present(port));
    if (next_pointer(port))
        bring(next_pointer(port), sizeof *next_pointer(port));
}

static void bring_drives(const struct md_port *port)
{
    const struct md_exchange *exchange = present(port);
    if (exchange)
        bring(exchange->drive, offsetof(struct md_drive, late_until_ns));
    if (exchange && exchange->block)
        bring(exchange->block, sizeof *exchange->block);
    if (next_pointer(port))
        bring_exchange(*next_pointer(port));
}

static void bring_rest(const struct md_port *port)
{
    if (present(port))
        bring(md_usual_delays(present(port)->drive), 1);
    if (next_pointer(port))
        bring((*next_pointer(port))->drive, offsetof(struct md_drive, counters));
}

/* The steps of prefetching, from the last to the first. In each round, each of the next STEPS_AHEAD ports
 * gets one step: the nearest port the last step, the farthest port the first. Each step reads memory that the
 * previous round prefetched. */
static void (*const steps[STEPS_AHEAD])(const struct md_port *port) = {
    bring_rest, bring_drives, bring_exchanges, bring_port,
};

/* Carry out one prefetch step for each of the ports next .. next + 3; `next` may be negative. */
static void prefetch(struct md_port *const *ports, int n, int next)
{
    for (int step = 0; step < STEPS_AHEAD; step++, next++)
        if (next >= 0 && next < n && ports[next])
            steps[step](ports[next]);
}

/* ---- the engine ---- */

#ifdef __linux__
#include <sys/prctl.h>
#endif

enum { READY = 256 }; /* limit of the ports handled between two waits */

static int64_t earliest(const struct md_engine *engine)
{
    int64_t least = MD_NEVER;
    for (unsigned i = 0; i < engine->count; i++)
        least = sooner(engine->wakes[i], least);
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
    if (left > 0 && late >= 0) { /* the thread has slept until its time or longer */
        late = sooner(late, MD_MOST_LATENESS);
        engine->lateness_ns += (late - engine->lateness_ns) / (late > engine->lateness_ns ? 4 : 16);
    }
    return n;
}

/* ---- ports come and go ---- */

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

/* Add the arriving ports, for which their clients wait. Only this thread may use the waiter. */
static void open_ports(struct md_engine *engine)
{
    for (struct md_port *port = engine->arriving; port; port = port->next) {
        port->is_opened = 1;
        if (!grow(engine) || md_waiter_add(engine->waiter, port->fd, port)) {
            port->open_error = errno;
            continue;
        }
        port->index = engine->count;
        engine->wakes[engine->count] = MD_NEVER;
        engine->ports[engine->count++] = port;
    }
    engine->has_news |= engine->arriving != NULL;
    engine->arriving = NULL;
}

/* Remove the closing ports. Their clients wait until this is done. */
static void close_ports(struct md_engine *engine)
{
    for (unsigned i = engine->count; i-- > 0;) {
        struct md_port *port = engine->ports[i];
        if (!port->is_closing || port->rs485.is_sending) /* do not cut off a stop that is leaving */
            continue;
        if (!port->turn.progress.lost)
            md_waiter_remove(engine->waiter, port->fd);
        md_turn_close(&port->turn);
        struct md_port *last = engine->ports[--engine->count];
        engine->ports[i] = last;
        engine->wakes[i] = engine->wakes[engine->count];
        last->index = i;
        port->is_closed = engine->has_news = 1;
    }
}

/* ---- the thread ---- */

/* Serve the readable ports; return the time afterwards, or 0 if no port was readable. */
static int64_t advance_ready(struct md_port *const *ready, int n, int *is_woken)
{
    int64_t now_ns = 0;
    *is_woken = 0;
    for (int i = -STEPS_AHEAD; i < n; i++) {
        prefetch(ready, n, i + 1);
        if (i < 0)
            continue;
        if (ready[i])
            now_ns = md_port_advance(ready[i], md_port_receive(ready[i]));
        else
            *is_woken = 1;
    }
    return now_ns;
}

/* Return 1 if the port can start an exchange from the client that woke the thread: the port is idle, or it
 * only listens and the exchange may be a stop. */
static int may_have_news(const struct md_port *port)
{
    return port->turn.source == MD_NO_SOURCE || port->turn.line.listened_ns;
}

/* Start or end realtime scheduling if a client waits for that. */
static void change_realtime(struct md_engine *engine)
{
    if (engine->is_realtime_changed)
        return;
    engine->realtime_failure = 0;
    if (engine->wants_realtime)
        engine->realtime_failure = md_realtime_start(&engine->realtime);
    else
        md_realtime_end(&engine->realtime);
    engine->is_realtime_changed = engine->has_news = 1;
}

/* Block SIGPIPE: writing to a port whose far end is closed must not end the process. */
static void ignore_broken_pipes(void)
{
#ifndef _WIN32
    sigset_t pipes;
    sigemptyset(&pipes);
    sigaddset(&pipes, SIGPIPE);
    pthread_sigmask(SIG_BLOCK, &pipes, NULL);
#endif
}

/* Let this thread's sleeps end on time: Linux may delay them by the timer slack, so make it as short as
 * possible. */
static void make_punctual(void)
{
#ifdef __linux__
    prctl(PR_SET_TIMERSLACK, 1UL, 0UL, 0UL, 0UL); /* the default is 50 us */
#endif
}

static void *run(void *argument)
{
    struct md_engine *engine = argument;
    void *ready[READY];
    int is_woken;
    ignore_broken_pipes();
    make_punctual();
    pthread_mutex_lock(&engine->mutex);
    for (;;) {
        int64_t until_ns = earliest(engine);
        int has_news = engine->has_news;
        engine->has_news = 0;
        pthread_mutex_unlock(&engine->mutex);
        if (has_news) /* after unlocking: the waiting clients get the mutex immediately */
            pthread_cond_broadcast(&engine->changed);
        /* Yield, otherwise this thread would always win the mutex. A realtime thread would only yield to
         * other realtime threads; a client that holds the mutex inherits the thread's priority instead. */
        while (atomic_load(&engine->callers) && !engine->realtime.is_on)
            sched_yield();
        int n = wait_until(engine, ready, until_ns);
        pthread_mutex_lock(&engine->mutex);
        int64_t now_ns = advance_ready((struct md_port *const *)ready, n, &is_woken);
        if (is_woken) {
            md_wakeup_silence(&engine->wakeup);
            open_ports(engine);
            close_ports(engine);
            change_realtime(engine);
        }
        if (!now_ns)
            now_ns = md_now_ns();
        md_realtime_check(&engine->realtime, now_ns);
        for (unsigned i = 0; i < engine->count; i++)
            if (engine->wakes[i] <= now_ns || (is_woken && may_have_news(engine->ports[i])))
                md_port_advance(engine->ports[i], md_now_ns());
    }
    return NULL;
}

static void free_engine(struct md_engine *engine)
{
    md_wakeup_destroy(&engine->wakeup);
    md_waiter_free(engine->waiter);
    pthread_mutex_destroy(&engine->mutex);
    pthread_cond_destroy(&engine->changed);
    free(engine);
}

/* Return an engine without a thread; NULL: see errno. */
static struct md_engine *new_engine(void)
{
    struct md_engine *engine = calloc(1, sizeof *engine);
    struct md_waiter *waiter = md_waiter_new();
    if (engine && waiter && md_wakeup_make(&engine->wakeup) == 0) {
        engine->waiter = waiter;
        engine->is_realtime_changed = 1;
        md_mutex_init(&engine->mutex);
        pthread_cond_init(&engine->changed, NULL);
        if (md_waiter_add(waiter, engine->wakeup.fd, NULL) == 0)
            return engine;
        free_engine(engine);
        return NULL;
    }
    if (waiter)
        md_waiter_free(waiter);
    free(engine);
    return NULL;
}

struct md_engine *md_engine_start(void)
{
    struct md_engine *engine = new_engine();
    if (!engine)
        return NULL;
    int failure = pthread_create(&engine->thread, NULL, run, engine);
    if (!failure)
        return engine;
    free_engine(engine);
    errno = failure;
    return NULL;
}

int md_wake_lateness(int is_realtime, int64_t period_ns, int64_t *late_ns, int n)
{
    struct md_engine *engine = new_engine();
    if (!engine)
        return -errno;
    void *ready[READY];
    make_punctual();
    int failure = is_realtime ? md_realtime_start(&engine->realtime) : 0;
    int64_t until_ns = md_now_ns();
    for (int i = 0; i < n && !failure; i++) {
        until_ns = later(until_ns, md_now_ns()) + period_ns;
        wait_until(engine, ready, until_ns);
        late_ns[i] = md_now_ns() - until_ns;
    }
    md_realtime_end(&engine->realtime);
    free_engine(engine);
    return failure;
}

/* ---- for clients ---- */

void md_engine_enter(struct md_engine *engine)
{
    atomic_fetch_add(&engine->callers, 1);
    pthread_mutex_lock(&engine->mutex);
    atomic_fetch_sub(&engine->callers, 1);
}

void md_engine_leave(struct md_engine *engine)
{
    pthread_mutex_unlock(&engine->mutex);
}

int md_engine_realtime(struct md_engine *engine, int wanted)
{
    md_engine_enter(engine);
    engine->wants_realtime = wanted;
    engine->is_realtime_changed = 0;
    md_engine_wake(engine);
    md_engine_await(engine, &engine->is_realtime_changed);
    int failure = engine->realtime_failure;
    md_engine_leave(engine);
    return failure;
}

int md_engine_is_realtime(struct md_engine *engine)
{
    return engine->realtime.is_on;
}

void md_engine_wake(struct md_engine *engine)
{
    md_wakeup_ring(&engine->wakeup);
}

void md_engine_await(struct md_engine *engine, const int *is_done)
{
    while (!*is_done)
        pthread_cond_wait(&engine->changed, &engine->mutex);
}
