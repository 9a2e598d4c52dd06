/* A client by another author: libmodbus reads a server. The argument is a port of 127.0.0.1 for Modbus TCP,
 * or the path of a serial port for RTU, with settings that no drive has.
 *
 * Each line of standard input is a request, each line of standard output its result:
 *   "UNIT FUNCTION START COUNT"   function 1 to 4: "words W W W", or bits
 *   "UNIT 5|6|16 START VALUE"     writes one coil or register: "written"
 * or "error N" with the exception code, or -1 for other errors. */
#include <errno.h>
#include <modbus.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

static int report(int result)
{
    if (result >= 0)
        return 1;
    printf("error %d\n", errno > MODBUS_ENOBASE && errno < EMBBADCRC ? errno - MODBUS_ENOBASE : -1);
    return 0;
}

static void read_some(modbus_t *client, int function, int start, int count)
{
    uint16_t words[MODBUS_MAX_READ_REGISTERS];
    uint8_t bits[MODBUS_MAX_READ_BITS];
    int result = function == 1   ? modbus_read_bits(client, start, count, bits)
                 : function == 2 ? modbus_read_input_bits(client, start, count, bits)
                 : function == 3 ? modbus_read_registers(client, start, count, words)
                                 : modbus_read_input_registers(client, start, count, words);
    if (!report(result))
        return;
    printf("words");
    for (int i = 0; i < result; i++)
        printf(" %d", function < 3 ? bits[i] : words[i]);
    printf("\n");
}

static void write_one(modbus_t *client, int function, int start, int value)
{
    uint16_t word = (uint16_t)value;
    int result = function == 5   ? modbus_write_bit(client, start, value)
                 : function == 6 ? modbus_write_register(client, start, word)
                                 : modbus_write_registers(client, start, 1, &word);
    if (report(result))
        printf("written\n");
}

int main(int argc, char **argv)
{
    int unit, function, start, count;
    modbus_t *client = argc != 2           ? NULL
                       : argv[1][0] == '/' ? modbus_new_rtu(argv[1], 1200, 'O', 8, 2)
                                           : modbus_new_tcp("127.0.0.1", atoi(argv[1]));
    if (!client || modbus_set_response_timeout(client, 30, 0) || modbus_connect(client)) {
        perror("libmodbus_client");
        return 1;
    }
    while (scanf("%d %d %d %d", &unit, &function, &start, &count) == 4) {
        modbus_set_slave(client, unit);
        if (function < 5)
            read_some(client, function, start, count);
        else
            write_one(client, function, start, count);
        fflush(stdout);
    }
    modbus_close(client);
    modbus_free(client);
    return 0;
}
