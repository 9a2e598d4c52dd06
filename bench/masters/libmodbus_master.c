/* libmodbus in C as a master: reads the drives in turn, as libmodbus's own examples do. For RTU over TCP, an
 * RTU context gets a connected socket. Prints the results as JSON. */
#include <arpa/inet.h>
#include <errno.h>
#include <modbus.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <time.h>

static double cpu_seconds(void)
{
    struct rusage used;
    getrusage(RUSAGE_SELF, &used);
    return (double)(used.ru_utime.tv_sec + used.ru_stime.tv_sec) +
           (double)(used.ru_utime.tv_usec + used.ru_stime.tv_usec) / 1e6;
}

static double now(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + (double)now.tv_nsec / 1e9;
}

static int connect_line(modbus_t *line, const char *path)
{
    int port, yes = 1;
    if (sscanf(path, "socket://127.0.0.1:%d", &port) != 1)
        return modbus_connect(line);
    struct sockaddr_in at = {
        .sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK), .sin_port = htons((uint16_t)port)};
    int fd = socket(AF_INET, SOCK_STREAM, 0);
    if (fd < 0 || connect(fd, (struct sockaddr *)&at, sizeof at))
        return -1;
    setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
    return modbus_set_socket(line, fd);
}

int main(int argc, char **argv)
{
    if (argc != 6) {
        fprintf(stderr, "usage: libmodbus_master PORT BAUDRATE DRIVES REGISTERS SECONDS\n");
        return 2;
    }
    int baudrate = atoi(argv[2]), drives = atoi(argv[3]), registers = atoi(argv[4]);
    modbus_t *line = modbus_new_rtu(argv[1], baudrate, 'N', 8, 1);
    if (!line || connect_line(line, argv[1])) {
        fprintf(stderr, "%s: %s\n", argv[1], modbus_strerror(errno));
        return 1;
    }
    modbus_set_response_timeout(line, 0, 300000);
    double begun = now(), end = begun + strtod(argv[5], NULL), cpu = cpu_seconds();
    long good = 0, bad = 0;
    while (now() < end) {
        uint16_t values[125];
        int address = 1 + (int)((good + bad) % drives), right = 1;
        modbus_set_slave(line, address);
        if (modbus_read_registers(line, 0, registers, values) == registers)
            for (int i = 0; i < registers; i++)
                right &= values[i] == 256 * address + i;
        else
            right = 0;
        good += right;
        bad += !right;
    }
    printf("{\"exchanges\": %ld, \"failures\": %ld, \"cpu_seconds\": %.6f, \"seconds\": %.6f, \"version\": \"%s\"}\n",
           good, bad, cpu_seconds() - cpu, now() - begun, LIBMODBUS_VERSION_STRING);
    modbus_close(line);
    modbus_free(line);
    return 0;
}
