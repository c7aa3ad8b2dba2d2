/* Reads holding registers with libmodbus, one request after the other, for some seconds.
 *
 *   libmodbus_client HOST PORT QUANTITY SECONDS
 *
 * Register N holds N. Prints the rate a second, and the processor time of a read in microseconds.
 */

#define _POSIX_C_SOURCE 200809L

#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

static double seconds(clockid_t clock)
{
    struct timespec now;
    clock_gettime(clock, &now);
    return now.tv_sec + now.tv_nsec / 1e9;
}

/* How many reads were done until the end. */
static long read_until(modbus_t *context, int quantity, double end)
{
    uint16_t registers[MODBUS_MAX_READ_REGISTERS];
    long count = 0;
    do {
        int got = modbus_read_registers(context, 0, quantity, registers);
        for (int at = 0; at < quantity; at++)
            if (got != quantity || registers[at] != at) {
                fprintf(stderr, "a wrong reply\n");
                exit(EXIT_FAILURE);
            }
        count++;
    } while (seconds(CLOCK_MONOTONIC) < end);
    return count;
}

int main(int count, char **words)
{
    if (count != 5)
        return EXIT_FAILURE;
    int quantity = atoi(words[3]);
    double time = atof(words[4]);
    modbus_t *context = modbus_new_tcp(words[1], atoi(words[2]));
    if (context == NULL || modbus_connect(context) < 0) {
        fprintf(stderr, "can't connect\n");
        return EXIT_FAILURE;
    }
    modbus_set_slave(context, 1);
    modbus_set_response_timeout(context, 10, 0);
    read_until(context, quantity, seconds(CLOCK_MONOTONIC) + time / 10);
    double began = seconds(CLOCK_MONOTONIC), worked = seconds(CLOCK_PROCESS_CPUTIME_ID);
    long reads = read_until(context, quantity, began + time);
    double took = seconds(CLOCK_MONOTONIC) - began;
    double work = seconds(CLOCK_PROCESS_CPUTIME_ID) - worked;
    printf("{\"rate\": %f, \"cpu_us\": %f}\n", reads / took, work / reads * 1e6);
    modbus_close(context);
    modbus_free(context);
    return EXIT_SUCCESS;
}
