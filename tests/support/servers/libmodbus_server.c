/* A server by another author: libmodbus answers at ADDRESS on PORT (9600 8N1) until killed.
 * Holding register n and input register n start as 1000 + n, coil n as n % 2.
 * Usage: libmodbus_server PORT ADDRESS */
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>

int main(int argc, char **argv)
{
    if (argc != 3)
        return 2;
    modbus_t *server = modbus_new_rtu(argv[1], 9600, 'N', 8, 1);
    modbus_mapping_t *map = modbus_mapping_new(64, 64, 256, 256);
    if (!server || !map || modbus_set_slave(server, atoi(argv[2])) || modbus_connect(server)) {
        fprintf(stderr, "%s\n", modbus_strerror(errno));
        return 1;
    }
    for (int i = 0; i < 256; i++)
        map->tab_registers[i] = map->tab_input_registers[i] = (uint16_t)(1000 + i);
    for (int i = 0; i < 64; i++)
        map->tab_bits[i] = map->tab_input_bits[i] = i % 2;
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
