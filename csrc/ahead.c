/* Memory that ports need for their next exchange, brought into the caches while others are dealt with.
 *
 * With many lines it has left the caches since the line's last exchange, and each exchange would wait a dozen
 * times for memory: more than a third of the core's own time with 1024 lines, a tenth with 256. The first
 * byte of each thing is read, because the processor drops the prefetch of a page for which it has no
 * translation. */
#include "engine.h"

enum { CACHE_LINE = 64 };

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

/* Return the exchange under way; NULL: there is none. */
static const struct md_exchange *present(const struct md_port *port)
{
    return port->turn.whose != MD_NOBODYS ? port->turn.line.exchange : NULL;
}

/* Return where the exchange to be repeated next is named; NULL: there is none. */
static const struct md_exchange *const *next_name(const struct md_port *port)
{
    const struct md_turn *turn = &port->turn;
    return turn->round_len ? &turn->round[turn->round_at] : NULL;
}

static void bring_exchanges(const struct md_port *port)
{
    if (present(port))
        bring_exchange(present(port));
    if (next_name(port))
        bring(next_name(port), sizeof *next_name(port));
}

static void bring_drives(const struct md_port *port)
{
    const struct md_exchange *exchange = present(port);
    if (exchange)
        bring(exchange->drive, offsetof(struct md_drive, late_until_ns));
    if (exchange && exchange->block)
        bring(exchange->block, sizeof *exchange->block);
    if (next_name(port))
        bring_exchange(*next_name(port));
}

static void bring_rest(const struct md_port *port)
{
    if (present(port))
        bring(md_usual_delays(present(port)->drive), 1);
    if (next_name(port))
        bring((*next_name(port))->drive, offsetof(struct md_drive, counters));
}

/* Each needs what the one behind it brought: the last one is for the port that is farthest ahead. */
static void (*const steps[MD_STEPS_AHEAD])(const struct md_port *port) = {
    bring_rest, bring_drives, bring_exchanges, bring_port,
};

void md_look_ahead(struct md_port *const *ports, int n, int next)
{
    for (int step = 0; step < MD_STEPS_AHEAD; step++, next++)
        if (next >= 0 && next < n && ports[next])
            steps[step](ports[next]);
}
