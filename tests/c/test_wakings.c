/* A client (a thread that asks for an exchange) wakes the engine's thread only if this thread would otherwise
 * serve the port too late. */
#define md_wakeup_ring ring
#include "posix/waiter.c"
#undef md_wakeup_ring

#include "answered_port.h"

enum { WANTED = 3, MOST_TRIES = 200 };
static const int64_t SILENCE_NS = 50000000, EARLY_NS = 80000;

static atomic_int rings;

void md_wakeup_ring(struct md_wakeup *wakeup)
{
    atomic_fetch_add(&rings, 1);
    ring(wakeup);
}

/* Carry out an exchange; return how often the client woke the engine's thread for it. */
static int asked(struct answered *drive, struct md_completion *found)
{
    int before = atomic_load(&rings);
    md_port_carry_out(drive->port, &drive->exchange, 0, 0, found, NULL);
    assert(found->result > 0);
    return atomic_load(&rings) - before;
}

int main(void)
{
    static struct answered drive;
    begin_answered(&drive, SILENCE_NS);

    /* During the silence between two requests, a client need not wake the thread, which wakes at the end of
     * the silence anyway. A client that comes later wakes the thread. */
    struct md_completion before, found;
    asked(&drive, &before);
    int unrung = 0;
    for (int tries = 0; unrung < WANTED; tries++) {
        assert(tries < MOST_TRIES);
        int rung = asked(&drive, &found);
        int64_t silent_ns = before.last_ns + SILENCE_NS;
        assert(rung == 0 || found.begun_ns >= silent_ns - EARLY_NS);
        assert(found.sent_ns >= silent_ns);
        unrung += rung == 0;
        before = found;
    }

    /* After a long silence the thread sleeps, and the client wakes it. On a busy machine the thread may still
     * be awake. */
    int rung = 0;
    for (int tries = 0; rung == 0; tries++) {
        assert(tries < MOST_TRIES);
        poll(NULL, 0, 3 * (int)(SILENCE_NS / 1000000));
        rung = asked(&drive, &found);
    }
    assert(rung == 1);

    end_answered(&drive);
    return 0;
}
