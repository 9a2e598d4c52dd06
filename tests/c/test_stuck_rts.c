/* The core discards a command that the driver has not sent yet in two cases: the wait for its last bit, after
 * which RTS is switched, takes too long; or its port is closed. The simulated driver has RTS, and never
 * sends. */
#define _GNU_SOURCE
#include <asm/ioctls.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "internal.h"

#include <assert.h>
#include <fcntl.h>
#include <pthread.h>
#include <sys/socket.h>

#ifdef __GLIBC__
int ioctl(int fd, unsigned long request, ...)
#else
int ioctl(int fd, int request, ...)
#endif
{
    __builtin_va_list arguments;
    __builtin_va_start(arguments, request);
    void *argument = __builtin_va_arg(arguments, void *);
    __builtin_va_end(arguments);
    if (request == TIOCMBIS || request == TIOCMBIC)
        return 0;
    return (int)syscall(SYS_ioctl, fd, request, argument);
}

static void *stop(void *port)
{
    usleep(100000);
    md_port_stop(port);
    return NULL;
}

/* Return 1 if the core discards the request that the driver holds. */
static int is_called_off(struct md_engine *engine, uint8_t function, int is_closed)
{
    static const int64_t TIMEOUT_NS = INT64_C(20000000000);
    struct md_history history = {0};
    struct md_drive drive = {.least_timeout_ns = TIMEOUT_NS, .most_timeout_ns = TIMEOUT_NS,
                             .history = &history};
    struct md_exchange exchange = {.drive = &drive, .character_ns = 1000, .framing = MD_RTU};
    exchange.request = (struct md_message){.address = 1, .function = function, .start = 1, .count = 1};
    exchange.request.data_len = function == 6 ? 2 : 0;
    struct md_completion found;
    pthread_t closing;
    int ends[2];
    int made = socketpair(AF_UNIX, SOCK_STREAM, 0, ends);
    assert(made == 0);
    fcntl(ends[0], F_SETFL, O_NONBLOCK);
    struct md_port *port = md_port_open(engine, ends[0], 0, MD_NO_TRANSACTIONS, 4);
    assert(port);
    int failure = md_port_rs485(port, MD_RS485_RTS_UP, 1);
    assert(!failure);
    if (is_closed)
        pthread_create(&closing, NULL, stop, port);
    md_port_carry_out(port, &exchange, 0, 0, &found, NULL);
    assert(found.result == MD_LINE_LOST && found.sent_ns);
    if (is_closed)
        pthread_join(closing, NULL);
    else
        md_port_stop(port);
    int called_off = (int)md_port_progress(port)->called_off;
    md_port_free(port, NULL);
    close(ends[0]);
    close(ends[1]);
    return called_off;
}

int main(void)
{
    alarm(60);
    struct md_engine *engine = md_engine_start();
    assert(engine);
    assert(is_called_off(engine, 6, 0));
    assert(is_called_off(engine, 6, 1));
    assert(!is_called_off(engine, 3, 0));
    return 0;
}
