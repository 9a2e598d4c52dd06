/* The functions of ports for clients, on any thread. */
#include "engine.h"

#include <stdlib.h>

static struct md_port *new_port(unsigned room)
{
    if (room == 0 || (room & (room - 1)))
        return NULL;
    struct md_port *port = calloc(1, sizeof *port);
    struct md_slot *slots = calloc(room, sizeof *slots);
    if (port && slots) {
        md_turn_init(&port->turn, slots, room, md_now_ns());
        return port;
    }
    free(port);
    free(slots);
    return NULL;
}

static void free_port(struct md_port *port)
{
    if (port->turn.row_queue)
        md_row_queue_release(port->turn.row_queue);
    free(port->turn.slots);
    free(port);
}

struct md_port *md_port_open(struct md_engine *engine, int fd, int must_take, int transactions,
                             unsigned room)
{
    struct md_port *port = new_port(room);
    if (!port) {
        errno = ENOMEM;
        return NULL;
    }
    port->engine = engine;
    port->fd = fd;
    port->must_take = must_take;
    port->turn.line.transactions = (uint8_t)transactions;
    port->is_watched = 1;
    port->doubts = MD_WRONG_COUNTS;
    /* Make the port raw before the first read: otherwise an empty read may return 0, as after a hang-up. */
    struct md_settings settings;
    if (must_take >= 0 && md_port_get(fd, &settings) == 0)
        md_port_set(fd, &settings);
    md_engine_enter(engine);
    port->next = engine->arriving;
    engine->arriving = port;
    md_engine_wake(engine);
    md_engine_await(engine, &port->is_opened);
    md_engine_leave(engine);
    if (!port->open_error)
        return port;
    int error = port->open_error;
    free_port(port);
    errno = error;
    return NULL;
}

void md_port_stop(struct md_port *port)
{
    md_engine_enter(port->engine);
    port->is_closing = 1;
    md_engine_wake(port->engine);
    md_engine_await(port->engine, &port->is_closed);
    md_engine_leave(port->engine);
}

void md_port_free(struct md_port *port, void *memory)
{
    (void)memory;
    md_port_stop(port);
    free_port(port);
}

int md_port_end(struct md_port *port)
{
    md_engine_enter(port->engine);
    int is_under_way = md_turn_end(&port->turn);
    md_engine_leave(port->engine);
    return is_under_way;
}

int md_port_is_asking(struct md_port *port, const struct md_drive *drive)
{
    md_engine_enter(port->engine);
    int is_asking = md_turn_is_asking(&port->turn, drive);
    md_engine_leave(port->engine);
    return is_asking;
}

int64_t md_port_counted_ns(struct md_port *port)
{
    md_engine_enter(port->engine);
    int64_t counted_ns = md_turn_counted_ns(&port->turn, md_now_ns());
    md_engine_leave(port->engine);
    return counted_ns;
}

void md_port_fence(struct md_port *port, struct md_mastership *mastership)
{
    md_engine_enter(port->engine);
    __atomic_store_n(&mastership->engine, port->engine, __ATOMIC_SEQ_CST);
    port->mastership = mastership;
    port->heard_term = 0; /* the stored number may belong to another mastership: listen to the line again */
    md_engine_leave(port->engine);
}

int md_port_rs485(struct md_port *port, int mode, int is_usb)
{
    md_engine_enter(port->engine);
    int failure = md_rs485_begin(port, mode, is_usb);
    md_engine_leave(port->engine);
    return failure;
}

void md_port_tap(struct md_port *port, struct md_tap *tap)
{
    md_engine_enter(port->engine);
    port->turn.line.tap = tap;
    md_engine_leave(port->engine);
}

void md_port_set_echo(struct md_port *port, int echo)
{
    md_engine_enter(port->engine);
    md_turn_set_echo(&port->turn, echo);
    md_engine_leave(port->engine);
}

void md_port_inherit(struct md_port *port, struct md_drive *drive, const struct md_drive *before)
{
    md_engine_enter(port->engine);
    md_late_inherit(drive, before);
    md_engine_leave(port->engine);
}

void md_port_report(struct md_port *port, struct md_row_queue *row_queue, uint32_t number)
{
    md_row_queue_hold(row_queue);
    md_engine_enter(port->engine);
    struct md_row_queue *before = port->turn.row_queue;
    port->turn.row_queue = row_queue;
    port->turn.number = number;
    md_engine_leave(port->engine);
    if (before)
        md_row_queue_release(before);
}

int md_port_submit(struct md_port *port, const struct md_exchange *const *exchanges,
                   const int64_t *not_before_ns, int n)
{
    int taken = md_turn_submit(&port->turn, exchanges, not_before_ns, n);
    if (taken && __atomic_exchange_n(&port->turn.is_idle, 0, __ATOMIC_SEQ_CST))
        md_engine_wake(port->engine);
    return taken;
}

unsigned md_port_repeat(struct md_port *port, const struct md_exchange *const *exchanges, unsigned n)
{
    md_engine_enter(port->engine);
    unsigned next = md_turn_repeat(&port->turn, exchanges, n);
    md_engine_leave(port->engine);
    md_engine_wake(port->engine);
    return next;
}

const struct md_progress *md_port_progress(struct md_port *port)
{
    return &port->turn.progress;
}

/* Return 1 if the thread will serve the port before the next request can leave, so that the client need not
 * wake the thread. Return 0 while the port listens for another master: a stop does not wait for the end of
 * listening, so the client must wake the thread. */
static int is_attended(const struct md_port *port)
{
    if (port->turn.line.listened_ns)
        return 0;
    return port->turn.source != MD_NO_SOURCE ||
           port->engine->wakes[port->index] <= md_line_silent_ns(&port->turn.line);
}

int md_port_carry_out(struct md_port *port, const struct md_exchange *exchange, int64_t not_before_ns,
                      int64_t expires_ns, struct md_completion *completion, double *values)
{
    struct md_engine *engine = port->engine; /* kept here: during the wait another thread may free the port */
    struct md_urgent urgent = {.exchange = exchange, .not_before_ns = not_before_ns, .expires_ns = expires_ns,
                               .completion = completion};
    md_engine_enter(engine);
    int64_t late_until_ns = exchange->drive->late_until_ns;
    if (port->is_closing) { /* the engine has stopped serving this port */
        *completion = (struct md_completion){.result = MD_LINE_LOST};
    } else {
        md_turn_add_urgent(&port->turn, &urgent);
        if (!is_attended(port))
            md_engine_wake(engine);
        md_engine_await(engine, &urgent.is_done);
    }
    md_engine_leave(engine);
    completion->late_until_ns = late_until_ns;
    if (completion->result <= 0 || completion->reply.exception)
        return -1;
    return exchange->values ? md_values(exchange->values, &completion->reply, values) : 0;
}

/* The engine's thread holds its mutex from the check of the deadline to the end of write(2). So once the
 * caller has reset the deadline and then held the mutex, no write is in flight. */
void md_mastership_end(struct md_mastership *mastership)
{
    __atomic_store_n(&mastership->until_ns, 0, __ATOMIC_SEQ_CST);
    struct md_engine *engine = __atomic_load_n(&mastership->engine, __ATOMIC_SEQ_CST);
    if (engine) {
        md_engine_enter(engine);
        md_engine_leave(engine);
    }
    md_mastership_extend(mastership, 0, 0); /* disarm the timer */
}
