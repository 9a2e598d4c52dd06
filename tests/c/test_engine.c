/* Several threads open and close ports on one engine while it carries out exchanges. */
#include "internal.h"

#include <assert.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

enum { CLIENTS = 4, ROUNDS = 60, QUEUED = 3, ROOM = 4 };

static struct md_engine *engine;
static struct md_row_queue *row_queue;
static int is_over;

/* A drive that never replies, and an exchange that reads from it. */
struct subject {
    struct md_history history;
    struct md_drive drive;
    struct md_exchange exchange;
};

static void make(struct subject *subject)
{
    *subject = (struct subject){.drive = {.least_timeout_ns = 300000, .most_timeout_ns = 300000}};
    subject->drive.history = &subject->history;
    subject->exchange = (struct md_exchange){.drive = &subject->drive, .character_ns = 10000};
    subject->exchange.framing = MD_RTU;
    subject->exchange.request = (struct md_message){.address = 1, .function = 3, .start = 1, .count = 1};
}

/* Repeatedly open a port, carry out exchanges, replace the drive by a second one, and close the port. */
static void *come_and_go(void *argument)
{
    uint32_t number = *(uint32_t *)argument;
    struct subject first, second;
    make(&first);
    make(&second);
    const struct md_exchange *queued[QUEUED] = {&first.exchange, &first.exchange, &first.exchange};
    const struct md_exchange *round[1] = {&second.exchange};
    const int64_t at_once[QUEUED] = {0, 0, 0};
    for (int i = 0; i < ROUNDS; i++) {
        int ends[2];
        int made = socketpair(AF_UNIX, SOCK_STREAM, 0, ends);
        assert(made == 0);
        fcntl(ends[0], F_SETFL, O_NONBLOCK);
        struct md_port *port = md_port_open(engine, ends[0], -1, MD_NO_TRANSACTIONS, ROOM);
        assert(port);
        md_port_report(port, row_queue, number);
        md_port_submit(port, queued, at_once, QUEUED);
        if (i % 3) /* every third time, the port is closed during an exchange */
            while (md_port_is_asking(port, &first.drive))
                usleep(100);
        md_port_inherit(port, &second.drive, &first.drive);
        assert(!md_port_is_asking(port, &second.drive));
        md_port_repeat(port, round, 1);
        struct md_completion found;
        if (i % 2)
            md_port_carry_out(port, &second.exchange, 0, 0, &found, NULL);
        md_port_repeat(port, NULL, 0);
        while (i % 5 == 0 && md_port_is_asking(port, &second.drive))
            usleep(100);
        md_port_end(port);
        md_port_stop(port);
        md_port_free(port, NULL);
        close(ends[0]);
        close(ends[1]);
    }
    return NULL;
}

/* Take rows on another thread at the same time, as a poller's consumer does. */
static void *take_calls(void *argument)
{
    (void)argument;
    uint32_t numbers[CLIENTS];
    while (!__atomic_load_n(&is_over, __ATOMIC_SEQ_CST))
        md_row_queue_await(row_queue, 1000000, numbers, CLIENTS);
    return NULL;
}

/* Check that writing to a closed socket loses only the port, even if the program restored the default action
 * of SIGPIPE, which kills a process. */
static void check_a_broken_pipe_is_a_lost_port(void)
{
    struct subject subject;
    struct md_completion found;
    int ends[2];
    make(&subject);
    int made = socketpair(AF_UNIX, SOCK_STREAM, 0, ends);
    assert(made == 0);
    fcntl(ends[0], F_SETFL, O_NONBLOCK);
    shutdown(ends[1], SHUT_RD);
    struct md_port *port = md_port_open(engine, ends[0], -1, MD_NO_TRANSACTIONS, ROOM);
    assert(port);
    md_port_carry_out(port, &subject.exchange, 0, 0, &found, NULL);
    assert(found.result == MD_LINE_LOST && found.error == EPIPE && !found.sent_ns);
    md_port_stop(port);
    md_port_free(port, NULL);
    close(ends[0]);
    close(ends[1]);
}

int main(void)
{
    engine = md_engine_start();
    row_queue = md_row_queue_new(16, 2);
    assert(engine && row_queue);
    check_a_broken_pipe_is_a_lost_port();
    pthread_t clients[CLIENTS], taker;
    uint32_t numbers[CLIENTS];
    pthread_create(&taker, NULL, take_calls, NULL);
    for (uint32_t i = 0; i < CLIENTS; i++) {
        numbers[i] = i;
        pthread_create(&clients[i], NULL, come_and_go, &numbers[i]);
    }
    for (int i = 0; i < CLIENTS; i++)
        pthread_join(clients[i], NULL);
    __atomic_store_n(&is_over, 1, __ATOMIC_SEQ_CST);
    pthread_join(taker, NULL);
    md_row_queue_release(row_queue);
    return 0;
}
