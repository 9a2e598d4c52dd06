/* At the end of the silence before a request, the engine's thread spins if the request is in its queue. It
 * sleeps if the request comes from a client's thread. */
#include "internal.h"

#include <assert.h>
#include <fcntl.h>
#include <poll.h>
#include <pthread.h>
#include <sys/socket.h>
#include <unistd.h>

enum {
    BY_HAND = 50, MOST_TRIES = 500,
    FEW = 60 /* limit of clock readings per exchange; a spinning thread makes about 30 per us */
};
static const int64_t SILENCE_NS = 3000000, TIMEOUT_NS = INT64_C(5000000000);

/* ---- these functions replace clock.c ---- */

static atomic_int looks;

int64_t md_now_ns(void)
{
    struct timespec now;
    atomic_fetch_add(&looks, 1);
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * MD_SECOND_NS + now.tv_nsec;
}

int64_t md_utc_minus_monotonic_ns(void)
{
    return 0;
}

int64_t md_utc_ahead_ns(int64_t now_ns)
{
    (void)now_ns;
    return 0;
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

static void ask_by_hand(struct md_port *port, const struct md_exchange *exchange)
{
    struct md_completion found;
    md_port_carry_out(port, exchange, 0, 0, &found, NULL);
    assert(found.result > 0);
}

static void ask_queued(struct md_port *port, const struct md_exchange *exchange)
{
    const struct md_progress *progress = md_port_progress(port);
    int64_t at_once = 0;
    md_port_submit(port, &exchange, &at_once, 1);
    while (__atomic_load_n(&progress->done, __ATOMIC_SEQ_CST) != progress->submitted)
        poll(NULL, 0, 1);
}

/* Return how often the engine reads the clock during one exchange. */
static int looks_of(void (*ask)(struct md_port *, const struct md_exchange *), struct md_port *port,
                    const struct md_exchange *exchange)
{
    int before = atomic_load(&looks);
    ask(port, exchange);
    return atomic_load(&looks) - before;
}

int main(void)
{
    alarm(60);
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

    int tries = 0; /* on a busy machine the thread may wake too late to spin */
    while (looks_of(ask_queued, port, &exchange) <= FEW)
        assert(++tries < MOST_TRIES);
    for (int i = 0; i < BY_HAND; i++)
        assert(looks_of(ask_by_hand, port, &exchange) <= FEW);

    md_port_stop(port);
    md_port_free(port, NULL);
    close(ends[0]);
    shutdown(ends[1], SHUT_RDWR);
    pthread_join(drives, NULL);
    close(ends[1]);
    return 0;
}
