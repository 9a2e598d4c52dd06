/* Print how libmodbus decodes frames. Each line of standard input is a case. For each case, a line of
 * standard output has the result.
 *
 * libmodbus reads from a socket pair that ends after the frame, so that no read waits.
 *   "request FRAME"
 *       A server at the frame's address receives FRAME. The result is "refused ERRNO", or "taken LENGTH
 *       REPLY CHANGES" with the server's reply (- for none) and each cell that it changed, as
 *       table:address:value (- for none).
 *   "reply ADDRESS FUNCTION START COUNT DATA FRAME"
 *       A client sends a request and receives FRAME. The result is "REQUEST VALUES" with the request and the
 *       values that it read (- for a write), or "REQUEST error ERRNO".
 * Frames and data are in hexadecimal, - if empty; numbers are decimal. libmodbus's own error numbers are
 * printed relative to MODBUS_ENOBASE, those of the system as negative numbers. */
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

enum { CELLS = 65536, MOST_FRAME = 1024, MOST_LINE = 8192 };

static modbus_t *peer;
static modbus_mapping_t *map;
static uint8_t coils[CELLS];
static uint16_t registers[CELLS];

static size_t unhex(const char *text, uint8_t *out)
{
    size_t len = 0;
    for (; text[0] != '-' && text[2 * len]; len++) {
        unsigned octet;
        sscanf(text + 2 * len, "%2x", &octet);
        out[len] = (uint8_t)octet;
    }
    return len;
}

static void show(const uint8_t *bytes, ssize_t len)
{
    for (ssize_t i = 0; i < len; i++)
        printf("%02x", bytes[i]);
    if (len <= 0)
        putchar('-');
}

static int own_errno(void)
{
    return errno >= MODBUS_ENOBASE ? errno - MODBUS_ENOBASE : -errno;
}

/* Connect libmodbus to a socket from which it will read this frame; return the socket's other end. */
static int say(const uint8_t *frame, size_t len)
{
    int ends[2];
    if (socketpair(AF_UNIX, SOCK_STREAM, 0, ends) || write(ends[1], frame, len) != (ssize_t)len ||
        shutdown(ends[1], SHUT_WR))
        exit(1);
    modbus_set_socket(peer, ends[0]);
    return ends[1];
}

/* Read the bytes that libmodbus sent, and close the sockets; return the number of bytes. */
static ssize_t hear(int end, uint8_t *out)
{
    shutdown(modbus_get_socket(peer), SHUT_WR);
    ssize_t len = read(end, out, MOST_FRAME);
    close(end);
    close(modbus_get_socket(peer));
    return len;
}

static void fill(void)
{
    for (int i = 0; i < CELLS; i++) {
        map->tab_bits[i] = coils[i] = i % 3 == 0;
        map->tab_input_bits[i] = i % 5 == 0;
        map->tab_registers[i] = registers[i] = (uint16_t)(i * 31 + 7);
        map->tab_input_registers[i] = (uint16_t)(i * 17 + 3);
    }
}

static void show_changes(void)
{
    int changes = 0;
    if (memcmp(map->tab_bits, coils, sizeof coils) ||
        memcmp(map->tab_registers, registers, sizeof registers)) {
        for (int i = 0; i < CELLS; i++) {
            if (map->tab_bits[i] != coils[i])
                printf("%s1:%d:%d", changes++ ? "," : "", i, map->tab_bits[i]);
            if (map->tab_registers[i] != registers[i])
                printf("%s3:%d:%d", changes++ ? "," : "", i, map->tab_registers[i]);
        }
        fill();
    }
    puts(changes ? "" : "-");
}

static void judge_request(const char *text)
{
    uint8_t frame[MOST_FRAME], request[MODBUS_RTU_MAX_ADU_LENGTH], reply[MOST_FRAME];
    size_t len = unhex(text, frame);
    if (!len || modbus_set_slave(peer, frame[0])) {
        puts("refused 0");
        return;
    }
    int end = say(frame, len);
    int used = modbus_receive(peer, request);
    int error = own_errno();
    if (used > 0)
        modbus_reply(peer, request, used, map);
    ssize_t said = hear(end, reply);
    if (used <= 0) {
        printf("refused %d\n", error);
        return;
    }
    printf("taken %d ", used);
    show(reply, said);
    putchar(' ');
    show_changes();
}

/* Let libmodbus make a request as a client; return the number of values in the reply, or -1. */
static int ask(int function, int start, int count, const uint8_t *data, uint8_t *bits, uint16_t *words)
{
    for (int i = 0; i < count && function == 0x0F; i++)
        bits[i] = data[i / 8] >> i % 8 & 1;
    for (int i = 0; i < count && function == 0x10; i++)
        words[i] = (uint16_t)(data[2 * i] << 8 | data[2 * i + 1]);
    switch (function) {
    case 0x01: return modbus_read_bits(peer, start, count, bits);
    case 0x02: return modbus_read_input_bits(peer, start, count, bits);
    case 0x03: return modbus_read_registers(peer, start, count, words);
    case 0x04: return modbus_read_input_registers(peer, start, count, words);
    case 0x05: return modbus_write_bit(peer, start, data[0] != 0);
    case 0x06: return modbus_write_register(peer, start, (uint16_t)(data[0] << 8 | data[1]));
    case 0x0F: return modbus_write_bits(peer, start, count, bits);
    case 0x10: return modbus_write_registers(peer, start, count, words);
    default: exit(2);
    }
}

static void judge_reply(int address, int function, int start, int count, const char *data_text,
                        const char *text)
{
    uint8_t frame[MOST_FRAME], data[MOST_FRAME], request[MOST_FRAME], bits[2048] = {0};
    uint16_t words[128] = {0};
    unhex(data_text, data);
    modbus_set_slave(peer, address);
    int end = say(frame, unhex(text, frame));
    int got = ask(function, start, count, data, bits, words);
    int error = own_errno();
    show(request, hear(end, request));
    if (got < 0)
        printf(" error %d\n", error);
    else if (function > 4)
        puts(" -");
    else
        for (int i = 0; i < got; i++)
            printf("%c%d%s", i ? ',' : ' ', function < 3 ? bits[i] : words[i], i == got - 1 ? "\n" : "");
}

int main(void)
{
    static char line[MOST_LINE], first[MOST_LINE], second[MOST_LINE];
    int address, function, start, count;
    peer = modbus_new_rtu("/dev/null", 9600, 'N', 8, 1);
    map = modbus_mapping_new(CELLS, CELLS, CELLS, CELLS);
    if (!peer || !map)
        return 1;
    modbus_set_response_timeout(peer, 0, 1000); /* libmodbus also sleeps this long before exception 03 */
    fill();
    while (fgets(line, sizeof line, stdin)) {
        if (sscanf(line, "request %s", first) == 1)
            judge_request(first);
        else if (sscanf(line, "reply %d %d %d %d %s %s", &address, &function, &start, &count, first,
                        second) == 6)
            judge_reply(address, function, start, count, first, second);
        else
            return 2;
    }
    modbus_mapping_free(map);
    modbus_free(peer);
    return 0;
}
