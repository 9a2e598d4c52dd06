/* A server by another author: libmodbus answers until killed, at ADDRESS on PORT (9600 8N1), or, without
 * arguments, every unit over Modbus TCP. It prints "ready", and for Modbus TCP its port, a free one.
 * Holding register n and input register n start as 1000 + n, coil n as n % 2.
 * Usage: libmodbus_server [PORT ADDRESS] */
#include <arpa/inet.h>
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>

static int serve_line(const char *port, int address, modbus_mapping_t *map)
{
    modbus_t *server = modbus_new_rtu(port, 9600, 'N', 8, 1);
    if (!server || modbus_set_slave(server, address) || modbus_connect(server)) {
        fprintf(stderr, "%s\n", modbus_strerror(errno));
        return 1;
    }
    puts("ready");
    fflush(stdout);
    for (;;) {
        uint8_t request[MODBUS_RTU_MAX_ADU_LENGTH];
        int length = modbus_receive(server, request);
        if (length > 0)
            modbus_reply(server, request, length, map);
        else if (length < 0 && errno != EMBBADCRC && errno != ETIMEDOUT && errno != EMBBADDATA)
            return 1;
    }
}

static int serve_tcp(modbus_mapping_t *map)
{
    modbus_t *server = modbus_new_tcp("127.0.0.1", 0);
    int listener = socket(AF_INET, SOCK_STREAM, 0);
    struct sockaddr_in place = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    socklen_t size = sizeof place;
    if (!server || listener < 0 || bind(listener, (struct sockaddr *)&place, size) || listen(listener, 1) ||
        getsockname(listener, (struct sockaddr *)&place, &size)) {
        perror("libmodbus_server");
        return 1;
    }
    printf("ready %d\n", ntohs(place.sin_port));
    fflush(stdout);
    for (;;) {
        if (modbus_tcp_accept(server, &listener) < 0)
            return 1;
        uint8_t request[MODBUS_TCP_MAX_ADU_LENGTH];
        int length;
        while ((length = modbus_receive(server, request)) >= 0)
            if (length > 0)
                modbus_reply(server, request, length, map);
        modbus_close(server);
    }
}

int main(int argc, char **argv)
{
    modbus_mapping_t *map = modbus_mapping_new(64, 64, 256, 256);
    if (!map || (argc != 1 && argc != 3))
        return 2;
    for (int i = 0; i < 256; i++)
        map->tab_registers[i] = map->tab_input_registers[i] = (uint16_t)(1000 + i);
    for (int i = 0; i < 64; i++)
        map->tab_bits[i] = map->tab_input_bits[i] = i % 2;
    return argc == 3 ? serve_line(argv[1], atoi(argv[2]), map) : serve_tcp(map);
}
