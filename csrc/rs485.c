/* Switch an RS-485 transceiver between sending and receiving: by the driver's RS-485 mode, or by RTS around
 * each request.
 *
 * RTS must fall after the last stop bit and before the drive's reply, which may start 3.5 characters later.
 * No function waits: the thread checks repeatedly. If a UART can report that its last bit has left
 * (TIOCSERGETLSR), this report decides.
 *
 * A USB adapter's report may be older than the request. The driver's queue is empty once the adapter has the
 * bytes, but then these bytes still take their whole time on the wire. */
#include "engine.h"

static const int64_t LOOK_AGAIN_NS = 200000;
static const int64_t ADAPTER_NS = 1000000; /* ns; one USB frame: the adapter may start to send this late */
enum { CLOCK_DEVIATION = 50 };             /* 1/50: the adapter's baud rate may be 2 % too low */
static const int64_t MOST_HELD_NS = 1000000000; /* if sending takes longer than this, the port is broken */

static int is_by_rts(const struct md_rs485 *rs485)
{
    return rs485->mode == MD_RS485_RTS_UP || rs485->mode == MD_RS485_RTS_DOWN;
}

static int set_direction(struct md_port *port, int is_sending)
{
    port->rs485.is_sending = is_sending;
    return md_descriptor_set_rts(port->fd, is_sending == (port->rs485.mode == MD_RS485_RTS_UP));
}

/* Return 1 if the last bit has left; otherwise set look_ns, the time of the next check. */
static int has_left(struct md_port *port, int64_t now_ns)
{
    struct md_rs485 *rs485 = &port->rs485;
    rs485->look_ns = now_ns + LOOK_AGAIN_NS;
    if (rs485->reports_end)
        return md_descriptor_is_shifted_out(port->fd) != 0;
    if (md_descriptor_is_queued(port->fd)) {
        rs485->empty_ns = 0;
        return 0;
    }
    if (!rs485->empty_ns)
        rs485->empty_ns = now_ns;
    rs485->look_ns = rs485->empty_ns + rs485->wire_ns + rs485->wire_ns / CLOCK_DEVIATION + ADAPTER_NS;
    return now_ns >= rs485->look_ns;
}

int md_rs485_begin(struct md_port *port, int mode, int is_usb)
{
    int failure = 0;
    port->rs485 = (struct md_rs485){.mode = mode};
    if (mode == MD_RS485_KERNEL)
        failure = md_descriptor_take_rs485(port->fd);
    else if (is_by_rts(&port->rs485)) {
        port->rs485.reports_end = !is_usb && md_descriptor_is_shifted_out(port->fd) >= 0;
        failure = set_direction(port, 0);
        /* RTS off at closing would switch the transceiver to sending */
        if (!failure && mode == MD_RS485_RTS_DOWN)
            failure = md_port_keep_rts(port->fd);
    }
    if (failure)
        port->rs485.mode = MD_RS485_OFF;
    return failure;
}

ssize_t md_rs485_write(struct md_port *port, const uint8_t *bytes, size_t len)
{
    struct md_rs485 *rs485 = &port->rs485;
    if (!is_by_rts(rs485))
        return md_descriptor_write(port->fd, bytes, len);
    int was_sending = rs485->is_sending, failure = was_sending ? 0 : set_direction(port, 1);
    if (failure) {
        errno = -failure;
        return -1;
    }
    ssize_t written = md_descriptor_write(port->fd, bytes, len);
    int error = errno;
    if (written > 0) {
        int64_t now_ns = md_now_ns(), wire_ns = written * port->turn.line.exchange->character_ns;
        rs485->wire_ns = was_sending ? rs485->wire_ns + wire_ns : wire_ns;
        rs485->sent_ns = later(rs485->sent_ns, now_ns) + wire_ns;
        rs485->look_ns = rs485->reports_end ? rs485->sent_ns : now_ns;
        rs485->empty_ns = 0;
    } else if (!was_sending) {
        set_direction(port, 0);
    }
    errno = error;
    return written;
}

int md_rs485_look(struct md_port *port, int64_t now_ns)
{
    struct md_rs485 *rs485 = &port->rs485;
    int is_lost = port->turn.progress.lost != 0, is_stuck = 0;
    if (!rs485->is_sending || (now_ns < rs485->look_ns && !is_lost))
        return 0;
    if (!is_lost && (!has_left(port, now_ns) || port->turn.line.state == MD_WRITING)) {
        is_stuck = now_ns > rs485->sent_ns + MOST_HELD_NS;
        if (!is_stuck)
            return 0;
    }
    int failure = set_direction(port, 0);
    if (port->is_closing) /* the engine waits for this switch before it closes the port */
        md_wakeup_ring(&port->engine->wakeup);
    return is_stuck ? -ETIMEDOUT : failure;
}
