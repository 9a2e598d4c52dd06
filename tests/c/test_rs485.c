/* Check when the core switches an RS-485 transceiver between sending and receiving. This test replaces the
 * clock, the serial driver's calls and write(2), and simulates the UART. */
#define _GNU_SOURCE
#include "checks.h"
#include "engine.h"

#include <errno.h>
#include <stdarg.h>
#include <sys/ioctl.h>
#ifdef __linux__
#include <linux/serial.h>
#endif

enum { CHARACTER_NS = 1145833, USB_NS = 1200000, FD = 1000 }; /* 9600 8N1 */

static struct {
    int64_t now_ns;
    int64_t start_ns;   /* time from a write to the first bit on the wire */
    int64_t percent;    /* actual time of a character, relative to the nominal one */
    int64_t taken_ns;   /* when the adapter has taken all bytes */
    int64_t end_ns;     /* when the last bit has been sent */
    int64_t changed_ns; /* when RTS was changed last */
    int is_up, changes, writes_while_receiving;
    int sending_level, takes, rings, keeps;
    int reports_end, rts_error, write_error;
    int is_usb;
    int has_mode, is_deaf;  /* the driver has an RS-485 mode; is_deaf: it ignores requests to use it */
    uint32_t flags;
} uart;

int64_t md_now_ns(void)
{
    return uart.now_ns;
}

void md_wakeup_ring(struct md_wakeup *wakeup)
{
    (void)wakeup;
    uart.rings++;
}

int md_port_keep_rts(int fd)
{
    uart.keeps += fd == FD;
    return 0;
}

static int refuse(int error)
{
    errno = error;
    return -1;
}

static int change(int is_up)
{
    if (uart.rts_error)
        return refuse(uart.rts_error);
    uart.changes += uart.is_up != is_up;
    uart.is_up = is_up;
    uart.changed_ns = uart.now_ns;
    return 0;
}

static int mode_of_driver(unsigned long request, void *argument)
{
    struct serial_rs485 *mode = argument;
    if (!uart.has_mode)
        return refuse(ENOTTY);
    if (request == TIOCSRS485 && !uart.is_deaf)
        uart.flags = mode->flags;
    mode->flags = uart.flags;
    mode->delay_rts_after_send = 7;
    return 0;
}

#ifdef __GLIBC__
int ioctl(int fd, unsigned long request, ...)
#else
int ioctl(int fd, int request, ...)
#endif
{
    va_list arguments;
    va_start(arguments, request);
    void *argument = va_arg(arguments, void *);
    va_end(arguments);
    int is_left = uart.now_ns >= uart.end_ns;
    CHECK(fd == FD);
    switch (request) {
    case TIOCMBIS:
    case TIOCMBIC:
        CHECK(*(int *)argument == TIOCM_RTS);
        return change(request == TIOCMBIS);
    case TIOCSERGETLSR:
        *(unsigned *)argument = is_left || uart.is_usb ? TIOCSER_TEMT : 0;
        return uart.reports_end ? 0 : refuse(ENOTTY);
    case TIOCOUTQ: /* a USB adapter takes all bytes before it sends the first one */
        *(int *)argument = uart.now_ns < uart.taken_ns;
        return 0;
    case TIOCGRS485:
    case TIOCSRS485:
        return mode_of_driver((unsigned long)request, argument);
    default:
        CHECK(request == TIOCOUTQ); /* the core must not make any other ioctl */
        return refuse(ENOTTY);
    }
}

ssize_t write(int fd, const void *bytes, size_t len)
{
    CHECK(fd == FD && bytes);
    uart.writes_while_receiving += uart.is_up != uart.sending_level;
    if (uart.write_error)
        return refuse(uart.write_error);
    size_t taken = len < (size_t)uart.takes ? len : (size_t)uart.takes;
    uart.taken_ns = uart.now_ns + uart.start_ns;
    uart.end_ns = later(uart.end_ns, uart.taken_ns) + (int64_t)taken * CHARACTER_NS * uart.percent / 100;
    return (ssize_t)taken;
}

static const struct md_exchange asked = {.character_ns = CHARACTER_NS};

static struct md_port *new_port(int mode, int is_usb)
{
    static struct md_engine engine;
    static struct md_port port;
    port = (struct md_port){.fd = FD, .engine = &engine, .turn.line.exchange = &asked};
    memset(&uart, 0, sizeof uart);
    uart.now_ns = 1000000000;
    uart.percent = 100;
    uart.takes = 1000;
    uart.sending_level = mode != MD_RS485_RTS_DOWN;
    uart.is_up = 1; /* open() raises RTS */
    uart.reports_end = 1; /* a USB driver reports the end too, but its report is outdated */
    uart.is_usb = is_usb;
    CHECK(md_rs485_begin(&port, mode, is_usb) == 0);
    return &port;
}

/* Call md_rs485_look() at each time it asks for, until the transceiver receives; return its failure or 0. */
static int look_until_received(struct md_port *port)
{
    for (int looks = 0; looks < 10000 && port->rs485.is_sending; looks++) {
        uart.now_ns = later(uart.now_ns, port->rs485.look_ns);
        int failure = md_rs485_look(port, uart.now_ns);
        if (failure)
            return failure;
    }
    CHECK(!port->rs485.is_sending && uart.is_up != uart.sending_level);
    return 0;
}

static void check_direction(void)
{
    static const struct {
        const char *row;
        int mode, is_usb, len;
        int64_t start_ns, percent, most_ns; /* most_ns: longest time from the last bit to the fall of RTS */
    } rows[] = {
        {"a UART", MD_RS485_RTS_UP, 0, 8, 0, 100, 0},
        {"RTS off while sending", MD_RS485_RTS_DOWN, 0, 8, 0, 100, 0},
        {"a UART that starts late", MD_RS485_RTS_UP, 0, 8, 3000000, 100, 200000},
        {"a slower UART", MD_RS485_RTS_UP, 0, 250, 0, 102, 200000},
        {"a faster UART", MD_RS485_RTS_UP, 0, 8, 0, 98, 8 * CHARACTER_NS / 50 + 1},
        {"a USB adapter", MD_RS485_RTS_UP, 1, 8, 0, 100, USB_NS + 8 * CHARACTER_NS / 50},
        {"a slower USB adapter", MD_RS485_RTS_UP, 1, 40, 0, 102, USB_NS},
        {"a USB adapter that takes the bytes late", MD_RS485_RTS_DOWN, 1, 8, 5000000, 100,
         USB_NS + 8 * CHARACTER_NS / 50},
    };
    static const uint8_t frame[256] = {0};
    for (size_t i = 0; i < COUNT(rows); i++) {
        row = rows[i].row;
        struct md_port *port = new_port(rows[i].mode, rows[i].is_usb);
        CHECK(uart.is_up != uart.sending_level); /* at first the transceiver receives */
        CHECK(uart.keeps == (rows[i].mode == MD_RS485_RTS_DOWN));
        uart.start_ns = rows[i].start_ns;
        uart.percent = rows[i].percent;
        for (int times = 0; times < 3; times++) {
            size_t len = (size_t)rows[i].len;
            CHECK(md_rs485_write(port, at_the_edge(frame, len), len) == rows[i].len);
            CHECK(port->rs485.is_sending && uart.is_up == uart.sending_level);
            CHECK(look_until_received(port) == 0);
            CHECK(uart.changed_ns >= uart.end_ns);
            CHECK(uart.changed_ns <= uart.end_ns + rows[i].most_ns);
            uart.now_ns += 100 * CHARACTER_NS;
        }
        CHECK(uart.writes_while_receiving == 0);
        row = "";
    }
}

static void check_parts(void)
{
    static const uint8_t frame[64] = {0};
    row = "a request that the port takes in parts";
    struct md_port *port = new_port(MD_RS485_RTS_UP, 0);
    uart.takes = 10;
    port->turn.line.state = MD_WRITING;
    int before = uart.changes;
    for (int at = 0; at < 64;) {
        at += (int)md_rs485_write(port, frame + at, (size_t)(64 - at));
        uart.now_ns = uart.end_ns + 5 * CHARACTER_NS; /* the rest of the frame is late: keep RTS on */
        CHECK(md_rs485_look(port, uart.now_ns) == 0 && uart.is_up);
    }
    port->turn.line.state = MD_AWAITING;
    CHECK(look_until_received(port) == 0 && uart.changes == before + 2);

    row = "a frame behind one that still leaves";
    port = new_port(MD_RS485_RTS_UP, 1);
    md_rs485_write(port, frame, 20);
    uart.now_ns += CHARACTER_NS;
    md_rs485_write(port, frame, 20);
    CHECK(look_until_received(port) == 0 && uart.changed_ns >= uart.end_ns);

    row = "a port that takes nothing";
    port = new_port(MD_RS485_RTS_UP, 0);
    uart.write_error = EAGAIN;
    CHECK(md_rs485_write(port, frame, 8) == -1 && errno == EAGAIN);
    CHECK(!uart.is_up && !port->rs485.is_sending);
    row = "";
}

static void check_failures(void)
{
    static const uint8_t frame[8] = {0};
    row = "a driver that does not switch RTS";
    struct md_port *port = new_port(MD_RS485_RTS_UP, 0);
    uart.rts_error = ENOTTY;
    CHECK(md_rs485_write(port, frame, 8) == -1 && errno == ENOTTY && uart.end_ns == 0);
    CHECK(md_rs485_begin(port, MD_RS485_RTS_UP, 0) == -ENOTTY && port->rs485.mode == MD_RS485_OFF);

    row = "RTS that does not fall any more";
    port = new_port(MD_RS485_RTS_UP, 0);
    md_rs485_write(port, frame, 8);
    uart.rts_error = EIO;
    CHECK(look_until_received(port) == -EIO && !port->rs485.is_sending);

    row = "a request that never leaves";
    port = new_port(MD_RS485_RTS_UP, 0);
    uart.start_ns = INT64_C(1000000000000);
    md_rs485_write(port, frame, 8);
    int64_t begun_ns = uart.now_ns;
    CHECK(look_until_received(port) == -ETIMEDOUT && !uart.is_up);
    CHECK(uart.now_ns - begun_ns < 1100000000);

    row = "a port that is lost";
    port = new_port(MD_RS485_RTS_UP, 0);
    md_rs485_write(port, frame, 8);
    port->turn.progress.lost = 1;
    CHECK(md_rs485_look(port, uart.now_ns) == 0 && !uart.is_up);

    row = "a port that is closed while its last request leaves";
    port = new_port(MD_RS485_RTS_UP, 0);
    md_rs485_write(port, frame, 8);
    port->is_closing = 1;
    CHECK(md_rs485_look(port, uart.now_ns) == 0 && uart.is_up && uart.rings == 0);
    CHECK(look_until_received(port) == 0 && uart.rings == 1);
    row = "";
}

static void check_driver(void)
{
    static const uint8_t frame[8] = {0};
    static const struct {
        const char *row;
        int has_mode, is_deaf;
        uint32_t before, after;
        int result;
    } rows[] = {
        {"a driver without the mode", 0, 0, 0, 0, -ENOTTY},
        {"one that does not take it", 1, 1, 0, 0, -EOPNOTSUPP},
        {"one that nobody set up", 1, 0, 0, SER_RS485_ENABLED | SER_RS485_RTS_ON_SEND, 0},
        {"one that is set up", 1, 0, SER_RS485_RTS_AFTER_SEND | SER_RS485_RX_DURING_TX,
         SER_RS485_ENABLED | SER_RS485_RTS_AFTER_SEND | SER_RS485_RX_DURING_TX, 0},
    };
    for (size_t i = 0; i < COUNT(rows); i++) {
        row = rows[i].row;
        struct md_port *port = new_port(MD_RS485_OFF, 0);
        uart.has_mode = rows[i].has_mode;
        uart.is_deaf = rows[i].is_deaf;
        uart.flags = rows[i].before;
        CHECK(md_rs485_begin(port, MD_RS485_KERNEL, 0) == rows[i].result);
        CHECK(uart.flags == rows[i].after);
        CHECK(md_rs485_write(port, frame, 8) == 8 && uart.changes == 0); /* RTS is left to the driver */
        row = "";
    }
}

int main(void)
{
    check_direction();
    check_parts();
    check_failures();
    check_driver();
    return end_of_checks();
}
