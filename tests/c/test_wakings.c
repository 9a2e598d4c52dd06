/* A client (a thread that asks for an exchange) wakes the engine's thread only if this thread would otherwise
 * serve the port too late. */
#define md_wakeup_ring ring
#include "posix/waiter.c"
#undef md_wakeup_ring

#include <assert.h>
#include <pthread.h>
#include <sys/socket.h>

enum { WANTED = 3, MOST_TRIES = 200 };
static const int64_t SILENCE_NS = 50000000, EARLY_NS = 80000, TIMEOUT_NS = INT64_C(5000000000);

static atomic_int rings;

void md_wakeup_ring(struct md_wakeup *wakeup)
{
    atomic_fetch_add(&rings, 1);
    ring(wakeup);
}

/* ---- a drive that answers immediately ---- */

static void *answer(void *argument)
{
    int fd = *(int *)argument;
    uint8_t request[8];
    struct md_message reply = {.address = 1, .function = 3, .start = 1, .count = 1, .data_len = 2};
    uint8_t frame[MD_KEPT_FRAME];
    int length = md_build_reply(MD_RTU, &reply, frame, sizeof frame);
    while (recv(fd, request, sizeof request, MSG_WAITALL) == (ssize_t)sizeof request)
        (void)!write(fd, frame, (size_t)length);
    return NULL;
}

/* Carry out an exchange; return how often the client woke the engine's thread for it. */
static int asked(struct md_port *port, const struct md_exchange *exchange, struct md_completion *found)
{
    int before = atomic_load(&rings);
    md_port_carry_out(port, exchange, 0, 0, found, NULL);
    assert(found->result > 0);
    return atomic_load(&rings) - before;
}

int main(void)
{
    alarm(60); /* end the test if the thread is never woken */
    struct md_history history = {0};
    struct md_drive drive = {.least_timeout_ns = TIMEOUT_NS, .most_timeout_ns = TIMEOUT_NS,
                             .history = &history};
    struct md_exchange exchange = {.drive = &drive, .character_ns = 10000, .silence_ns = SILENCE_NS,
                                   .framing = MD_RTU};
    exchange.request = (struct md_message){.address = 1, .function = 3, .start = 1, .count = 1};
    struct md_engine *engine = md_engine_start();
    int ends[2];
    int made = socketpair(AF_UNIX, SOCK_STREAM, 0, ends);
    assert(engine && made == 0);
    fcntl(ends[0], F_SETFL, O_NONBLOCK);
    pthread_t drives;
    pthread_create(&drives, NULL, answer, &ends[1]);
    struct md_port *port = md_port_open(engine, ends[0], -1, MD_NO_TRANSACTIONS, 4);
    assert(port);

    /* During the silence between two requests, a client need not wake the thread, which wakes at the end of
     * the silence anyway. A client that comes later wakes the thread. */
    struct md_completion before, found;
    asked(port, &exchange, &before);
    int unrung = 0;
    for (int tries = 0; unrung < WANTED; tries++) {
        assert(tries < MOST_TRIES);
        int rung = asked(port, &exchange, &found);
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
        rung = asked(port, &exchange, &found);
    }
    assert(rung == 1);

    md_port_stop(port);
    md_port_free(port, NULL);
    close(ends[0]);
    shutdown(ends[1], SHUT_RDWR);
    pthread_join(drives, NULL);
    close(ends[1]);
    return 0;
}
