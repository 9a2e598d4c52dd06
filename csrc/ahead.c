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

/* Fill in the exchange under way and the one that is to follow; return how many there are. */
static int find(const struct md_turn *turn, const struct md_exchange *exchanges[2])
{
    int n = 0;
    if (turn->whose != MD_NOBODYS)
        exchanges[n++] = turn->line.exchange;
    if (turn->round_len)
        exchanges[n++] = turn->round[turn->round_at];
    return n;
}

static void bring_exchanges(const struct md_port *port)
{
    const struct md_turn *turn = &port->turn;
    const struct md_exchange *exchanges[2];
    for (int n = find(turn, exchanges); n-- > 0;)
        bring(exchanges[n], offsetof(struct md_exchange, request.data));
}

static void bring_drives(const struct md_port *port)
{
    const struct md_turn *turn = &port->turn;
    const struct md_exchange *exchanges[2];
    for (int n = find(turn, exchanges); n-- > 0;)
        bring(exchanges[n]->drive, offsetof(struct md_drive, delays));
    if (turn->whose != MD_NOBODYS && turn->line.exchange->block)
        bring(turn->line.exchange->block, sizeof *turn->line.exchange->block);
}

static void bring_history(const struct md_port *port)
{
    const struct md_turn *turn = &port->turn;
    if (turn->whose != MD_NOBODYS)
        bring(md_usual_delays(turn->line.exchange->drive), 1);
}

/* Each needs what the one behind it brought: the last one is for the port that is farthest ahead. */
static void (*const steps[MD_STEPS_AHEAD])(const struct md_port *port) = {
    bring_history, bring_drives, bring_exchanges, bring_port,
};

void md_look_ahead(struct md_port *const *ports, int n, int next)
{
    for (int step = 0; step < MD_STEPS_AHEAD; step++, next++)
        if (next >= 0 && next < n && ports[next])
            steps[step](ports[next]);
}
