/* A port on the engine, and a drive at its far end that answers each read immediately. */
#ifndef ANSWERED_PORT_H
#define ANSWERED_PORT_H

#include "internal.h"

#include <assert.h>
#include <fcntl.h>
#include <poll.h>
#include <pthread.h>
#include <sys/socket.h>
#include <unistd.h>

struct answered {
    struct md_history history;
    struct md_drive drive;
    struct md_exchange exchange; /* a read */
    struct md_port *port;
    pthread_t answering;
    int ends[2];
};

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

static void begin_answered(struct answered *to, int64_t silence_ns)
{
    static const int64_t TIMEOUT_NS = INT64_C(5000000000);
    alarm(60); /* end the test if the engine's thread hangs */
    *to = (struct answered){.drive = {.least_timeout_ns = TIMEOUT_NS, .most_timeout_ns = TIMEOUT_NS}};
    to->drive.history = &to->history;
    to->exchange = (struct md_exchange){.drive = &to->drive, .character_ns = 10000, .silence_ns = silence_ns};
    to->exchange.framing = MD_RTU;
    to->exchange.request = (struct md_message){.address = 1, .function = 3, .start = 1, .count = 1};
    struct md_engine *engine = md_engine_start();
    int made = socketpair(AF_UNIX, SOCK_STREAM, 0, to->ends);
    assert(engine && made == 0);
    fcntl(to->ends[0], F_SETFL, O_NONBLOCK);
    pthread_create(&to->answering, NULL, answer, &to->ends[1]);
    to->port = md_port_open(engine, to->ends[0], -1, MD_NO_TRANSACTIONS, 4);
    assert(to->port);
}

static void end_answered(struct answered *to)
{
    md_port_stop(to->port);
    md_port_free(to->port, NULL);
    close(to->ends[0]);
    shutdown(to->ends[1], SHUT_RDWR);
    pthread_join(to->answering, NULL);
    close(to->ends[1]);
}

#endif
