/* With any number of ports, the engine reads a port only once per exchange if it can send the next request
 * immediately. */
#include <unistd.h>

static ssize_t counted(int fd, void *bytes, size_t room);
#define read counted
#define send send_request /* the included file's static send() would clash with the system's */
#include "port.c"
#undef send
#undef read

#include <assert.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdatomic.h>
#include <sys/socket.h>

enum { PORTS = MOST_SPINNING + 1, EXCHANGES = 500, REQUEST = 8 };
static const int64_t TIMEOUT_NS = INT64_C(20000000000);

static atomic_int reads;

static ssize_t counted(int fd, void *bytes, size_t room)
{
    atomic_fetch_add(&reads, 1);
    return read(fd, bytes, room);
}

/* Answer EXCHANGES requests immediately. */
static void *answer(void *argument)
{
    int fd = *(int *)argument;
    uint8_t request[REQUEST], frame[MD_KEPT_FRAME];
    struct md_message reply = {.address = 1, .function = 3, .start = 1, .count = 1, .data_len = 2};
    int length = md_build_reply(MD_RTU, &reply, frame, sizeof frame);
    for (int i = 0; i < EXCHANGES; i++) {
        ssize_t got = recv(fd, request, sizeof request, MSG_WAITALL);
        ssize_t put = write(fd, frame, (size_t)length);
        assert(got == REQUEST && put == length);
    }
    /* A further request shows that the engine has all replies. */
    ssize_t got = recv(fd, request, sizeof request, MSG_WAITALL);
    assert(got == REQUEST);
    return NULL;
}

int main(void)
{
    alarm(60);
    struct md_history history = {0};
    struct md_drive drive = {.least_timeout_ns = TIMEOUT_NS, .most_timeout_ns = TIMEOUT_NS,
                             .history = &history};
    struct md_exchange exchange = {.drive = &drive, .character_ns = 1, .silence_ns = 4, .framing = MD_RTU};
    exchange.request = (struct md_message){.address = 1, .function = 3, .start = 1, .count = 1};
    struct md_engine *engine = md_engine_start();
    struct md_port *ports[PORTS];
    int ends[PORTS][2];
    assert(engine);
    for (int i = 0; i < PORTS; i++) {
        int made = socketpair(AF_UNIX, SOCK_STREAM, 0, ends[i]);
        assert(made == 0);
        fcntl(ends[i][0], F_SETFL, O_NONBLOCK);
        ports[i] = md_port_open(engine, ends[i][0], -1, MD_NO_TRANSACTIONS, 4);
        assert(ports[i]);
    }
    pthread_t drives;
    pthread_create(&drives, NULL, answer, &ends[0][1]);
    const struct md_exchange *round[] = {&exchange};
    md_port_repeat(ports[0], round, 1);
    pthread_join(drives, NULL);
    int found = atomic_load(&reads);
    assert(found <= EXCHANGES + 1); /* one per exchange, and one before the first request */

    for (int i = 0; i < PORTS; i++) {
        md_port_stop(ports[i]);
        md_port_free(ports[i], NULL);
        close(ends[i][0]);
        close(ends[i][1]);
    }
    return 0;
}
