/* The server of libmodbus, for one client at a time: 1000 items in every area, unit 1. Input
 * register N holds N, every third discrete input is on.
 *
 *   libmodbus_server tcp            prints the port it listens on
 *   libmodbus_server rtu DEVICE     19200 baud, no parity, 2 stop bits
 *
 * It ends when it is killed.
 */

#include <arpa/inet.h>
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

enum { ITEMS = 1000 };

static modbus_mapping_t *filled(void)
{
    modbus_mapping_t *mapping = modbus_mapping_new(ITEMS, ITEMS, ITEMS, ITEMS);
    if (mapping == NULL)
        exit(EXIT_FAILURE);
    for (int at = 0; at < ITEMS; at++) {
        mapping->tab_input_registers[at] = at;
        mapping->tab_input_bits[at] = at % 3 == 0;
    }
    return mapping;
}

/* Answers until the connection or the line fails. */
static void serve(modbus_t *context, modbus_mapping_t *mapping)
{
    uint8_t request[MODBUS_TCP_MAX_ADU_LENGTH];
    for (;;) {
        int length = modbus_receive(context, request);
        if (length > 0)
            modbus_reply(context, request, length, mapping);
        else if (length < 0)
            return;
    }
}

static void fail(const char *what)
{
    fprintf(stderr, "%s: %s\n", what, modbus_strerror(errno));
    exit(EXIT_FAILURE);
}

static void serve_tcp(modbus_mapping_t *mapping)
{
    modbus_t *context = modbus_new_tcp("127.0.0.1", 0);
    int listener = context == NULL ? -1 : modbus_tcp_listen(context, 1);
    struct sockaddr_in address;
    socklen_t length = sizeof address;
    if (listener < 0 || getsockname(listener, (struct sockaddr *) &address, &length) < 0)
        fail("can't listen");
    printf("%d\n", ntohs(address.sin_port));
    fflush(stdout);
    for (;;) {
        if (modbus_tcp_accept(context, &listener) < 0)
            fail("can't accept");
        serve(context, mapping);
        modbus_close(context);
    }
}

static void serve_rtu(const char *device, modbus_mapping_t *mapping)
{
    modbus_t *context = modbus_new_rtu(device, 19200, 'N', 8, 2);
    if (context == NULL || modbus_set_slave(context, 1) < 0 || modbus_connect(context) < 0)
        fail("can't open the device");
    printf("0\n");
    fflush(stdout);
    for (;;)
        serve(context, mapping);
}

int main(int count, char **words)
{
    if (count == 2 && strcmp(words[1], "tcp") == 0)
        serve_tcp(filled());
    if (count == 3 && strcmp(words[1], "rtu") == 0)
        serve_rtu(words[2], filled());
    fprintf(stderr, "usage: %s tcp | rtu DEVICE\n", words[0]);
    return EXIT_FAILURE;
}
