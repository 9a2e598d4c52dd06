/* Check which baud rates the clock of a UART can yield. This test replaces the driver, which accepts any
 * baud rate. */
#define _GNU_SOURCE
#include "checks.h"
#include "multidrop.h"

#include <asm/termbits.h>
#include <errno.h>
#include <linux/serial.h>
#include <stdarg.h>
#include <sys/ioctl.h>

static struct serial_struct uart;
static struct termios2 taken;
static int has_clock;

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
    (void)fd;
    if (request == TCSETS2)
        taken = *(struct termios2 *)argument;
    else if (request == TCGETS2)
        *(struct termios2 *)argument = taken;
    else if (request == TIOCGSERIAL && has_clock)
        *(struct serial_struct *)argument = uart;
    else {
        errno = ENOTTY;
        return -1;
    }
    return 0;
}

int main(void)
{
    static const struct {
        const char *row;
        uint32_t baudrate;
        int has_clock, base, type, flags, custom, is_refused;
    } rows[] = {
        {"a whole divisor", 38400, 1, 115200, PORT_16550A, 0, 0, 0},
        {"divisor 1", 115200, 1, 115200, PORT_16550A, 0, 0, 0},
        {"57600 instead", 76800, 1, 115200, PORT_16550A, 0, 0, 1},
        {"12800 instead", 12345, 1, 115200, PORT_16550A, 0, 0, 1},
        {"0.16 % off", 38400, 1, 1500000, PORT_16550A, 0, 0, 0},
        {"2.4 % off", 500000, 1, 976000 * 2, PORT_16550A, 0, 0, 1},
        {"faster than the clock, as by a multiplier", 230400, 1, 115200, PORT_16550A, 0, 0, 0},
        {"a custom divisor", 38400, 1, 115200, PORT_16550A, ASYNC_SPD_CUST, 12, 1},
        {"one that changes nothing", 38400, 1, 115200, PORT_16550A, ASYNC_SPD_CUST, 3, 0},
        {"one for another baud rate", 9600, 1, 115200, PORT_16550A, ASYNC_SPD_CUST, 5, 0},
        {"no custom divisor although it is in use", 38400, 1, 115200, PORT_16550A, ASYNC_SPD_CUST, 0, 1},
        {"a prescaler", 76800, 1, 115200, PORT_16C950, 0, 0, 0},
        {"an unknown clock", 76800, 1, 0, PORT_16550A, 0, 0, 0},
        {"a driver that reports none", 76800, 0, 0, 0, 0, 0, 0},
    };
    for (size_t i = 0; i < COUNT(rows); i++) {
        row = rows[i].row;
        has_clock = rows[i].has_clock;
        uart = (struct serial_struct){.baud_base = rows[i].base, .type = rows[i].type, .flags = rows[i].flags,
                                      .custom_divisor = rows[i].custom};
        struct md_settings settings = {rows[i].baudrate, 8, 'N', 1};
        CHECK(md_port_set(1000, &settings) == (rows[i].is_refused ? MD_REFUSED_DIVISOR : 0));
        CHECK(md_port_baud_base(1000) == (uint32_t)rows[i].base);
    }
    return end_of_checks();
}
