/* Listening before the first request: a line has one master, and a new one finds out whether it is alone.
 * Bytes that come while nothing was asked are replies to another master, or its requests. Each of them begins
 * the wait anew, so that nothing is asked before the line has been silent for long enough.
 * The wait lasts for the guard at least: meanwhile a master before us that stands still is ended by its own
 * timer. On a connection of Modbus TCP no other master can be heard, and only the guard is waited for.
 *
 * A stop is not held up: whoever else is there, the motor must stop. */
#include "line.h"

enum { LONGEST_RTU = 256 }; /* serial-line guide V1.02, 2.5.1 */

/* One burst is borne: it may be the reply to what another master, which is gone, asked last. */
int md_listen_begin(struct md_line *line, int64_t now_ns, int64_t guard_ns)
{
    const struct md_exchange *exchange = line->exchange;
    int longest = exchange->framing == MD_ASCII ? MD_MOST_FRAME : LONGEST_RTU;
    if (line->state != MD_READY || (line->transactions && !guard_ns))
        return 0;
    md_line_go(line, MD_STRAY_BYTES);
    line->listen_ns = longest * exchange->character_ns + exchange->drive->most_timeout_ns;
    if (line->transactions)
        line->listen_ns = 0;
    line->listened_ns = now_ns + later(line->listen_ns, guard_ns);
    line->give_up_ns = line->listened_ns + line->listen_ns;
    return 1;
}

void md_listen_put_back(struct md_line *line)
{
    md_line_go(line, MD_ENDED);
}

void md_listen_hear(struct md_line *line, size_t len, int64_t now_ns)
{
    if (line->transactions) /* a late reply to ourselves */
        return;
    line->listened_ns = later(line->listened_ns, now_ns + line->listen_ns);
    line->foreign += (uint32_t)len;
}

int md_listen_end(struct md_line *line, int64_t now_ns)
{
    if (!md_listen_is_held(line)) /* a stop; what follows it goes on listening */
        return 1;
    if (now_ns < line->listened_ns)
        return 0;
    line->listened_ns = 0;
    return 1;
}
