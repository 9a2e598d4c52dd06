// SPDX-License-Identifier: GPL-2.0
/* Gives the PC's second serial port the RS-485 mode of the 8250 driver's own library, as the device trees of
 * some boards do. Without it, no driver of an emulated PC has that mode. */
#include <linux/module.h>
#include <linux/serial_8250.h>

/* from drivers/tty/serial/8250/8250.h, which is not among the kernel's headers */
extern const struct serial_rs485 serial8250_em485_supported;
int serial8250_em485_config(struct uart_port *port, struct ktermios *termios, struct serial_rs485 *rs485);
void serial8250_em485_start_tx(struct uart_8250_port *port);
void serial8250_em485_stop_tx(struct uart_8250_port *port);

static int line;

static int __init begin(void)
{
    struct uart_8250_port port = {
        .port = {
            .iobase = 0x2f8,
            .irq = 3,
            .uartclk = 1843200,
            .type = PORT_16550A,
            .iotype = UPIO_PORT,
            .flags = UPF_SKIP_TEST | UPF_FIXED_TYPE | UPF_BOOT_AUTOCONF,
            .rs485_config = serial8250_em485_config,
        },
        .rs485_start_tx = serial8250_em485_start_tx,
        .rs485_stop_tx = serial8250_em485_stop_tx,
    };
    port.port.rs485_supported = serial8250_em485_supported;
    line = serial8250_register_8250_port(&port);
    return line < 0 ? line : 0;
}

static void __exit end(void)
{
    serial8250_unregister_port(line);
}

module_init(begin);
module_exit(end);
MODULE_LICENSE("GPL");
MODULE_DESCRIPTION("RS-485 mode for a PC's second serial port");
