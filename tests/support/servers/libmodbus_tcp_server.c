/* A server by another author: libmodbus answers every unit over Modbus TCP until killed.
 * Registers and coils are those of libmodbus_server.c. It prints its free port as "ready PORT". */
#include <arpa/inet.h>
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <sys/socket.h>

int main(void)
{
    modbus_t *server = modbus_new_tcp("127.0.0.1", 0);
    modbus_mapping_t *map = modbus_mapping_new(64, 64, 256, 256);
    int listener = socket(AF_INET, SOCK_STREAM, 0);
    struct sockaddr_in place = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    socklen_t size = sizeof place;
    if (!server || !map || listener < 0 || bind(listener, (struct sockaddr *)&place, size) ||
        listen(listener, 1) || getsockname(listener, (struct sockaddr *)&place, &size)) {
        perror("libmodbus_tcp_server");
        return 1;
    }
    for (int i = 0; i < 256; i++)
        map->tab_registers[i] = map->tab_input_registers[i] = (uint16_t)(1000 + i);
    for (int i = 0; i < 64; i++)
        map->tab_bits[i] = map->tab_input_bits[i] = i % 2;
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
