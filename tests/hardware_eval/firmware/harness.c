/* The firmware's core behind a pipe: requests on stdin, replies on stdout, little-endian, packed.
 *
 * Request: u64 now, u64 time, i16 pressure, i16 flow, u8 (1 saturated, 2 lapsed), u32 n, n bytes.
 * Reply: u32 n, n bytes, u8 mode, u8 u_out, u16 u_in, u16 causes.
 * First, without a reply: u64 now, u8 id[8], u8 calibration[32], u8 noisy, u16 capabilities,
 * u16 limit, i32 highest, u8 n, n bytes of name. */
#include <stdio.h>
#include <stdlib.h>

#include "device.h"

/* Reads so many bytes; ends the program at the end of the input. */
static void take(void *to, size_t bytes)
{
    if (bytes && fread(to, 1, bytes, stdin) != bytes)
        exit(0);
}

/* Reads a number. */
static uint64_t number(unsigned bytes)
{
    uint8_t raw[8];
    take(raw, bytes);
    return wire_get(raw, bytes);
}

/* Writes a number. */
static void tell(uint64_t value, unsigned bytes)
{
    uint8_t raw[8];
    wire_put(raw, value, bytes);
    fwrite(raw, 1, bytes, stdout);
}

int main(void)
{
    static uint8_t data[1 << 20], answers[8 << 20];
    struct identity identity = {0};
    struct device device;
    uint64_t begun = number(8);
    take(identity.device_id, 8);
    take(identity.calibration, 32);
    identity.noisy = number(1) != 0;
    identity.capabilities = (uint16_t)number(2);
    identity.pressure_limit = (uint16_t)number(2);
    identity.highest = (int32_t)number(4);
    identity.name_length = (uint8_t)number(1);
    take(identity.name, identity.name_length);
    device_init(&device, &identity, begun);
    for (;;) {
        struct sample sample;
        uint64_t now = number(8);
        sample.time = number(8);
        sample.pressure = (int16_t)number(2);
        sample.flow = (int16_t)number(2);
        unsigned marks = (unsigned)number(1);
        sample.saturated = marks & 1;
        sample.lapsed = marks & 2;
        size_t length = number(4), from = 0, sent = 0;
        if (length > sizeof data)
            return 1;
        take(data, length);
        do {
            size_t part = length - from < DEVICE_CHUNK ? length - from : DEVICE_CHUNK;
            uint8_t *room = malloc(DEVICE_ANSWERS); /* so that the sanitizer sees its end */
            size_t bytes = device_step(&device, now, &sample, data + from, part, room);
            for (size_t i = 0; i < bytes; i++)
                answers[sent++] = room[i];
            free(room);
            from += part;
        } while (from < length);
        tell(sent, 4);
        fwrite(answers, 1, sent, stdout);
        tell(device.mode, 1);
        tell(device.u_out, 1);
        tell(device.u_in, 2);
        tell(device.causes, 2);
        fflush(stdout);
    }
}
