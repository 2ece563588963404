/* The loop of a device: sample, step, set the valves, answer.
 *
 * Sensors and valves are on a bus, in frames as on the wire without its header. An order of a board
 * that has just started ('?') is answered with what the electronics are ('I'), later ones ('O')
 * with a sample ('S'). A board with a converter and PWM of its own replaces `take` and `order`. */
#include <string.h>

#include "board.h"
#include "device.h"

enum { IDENTITY_BYTES = 1 + 8 + 32 + 2 + 4 + 1, SAMPLE_BYTES = 1 + 2 + 2 + 1 + 4 };

static struct device device;
static struct wire_parser bus;
static struct identity identity;
static struct sample newest = {.pressure = DEVICE_UNKNOWN, .flow = DEVICE_UNKNOWN};

/* Orders the valves: time, inspiratory valve, expiratory valve. */
static void order(uint16_t u_in, uint8_t u_out)
{
    uint8_t packet[1 + 8 + 2 + 1 + WIRE_CRC] = {identity.name_length ? 'O' : '?'};
    uint8_t frame[sizeof packet + 3];
    wire_put(wire_put(wire_put(packet + 1, board_now(), 8), u_in, 2), u_out, 1);
    board_write(BOARD_BUS, frame, wire_frame(packet, sizeof packet - WIRE_CRC, frame));
}

/* The program stands still: vents without it. */
void board_lost(void)
{
    order(0, 1);
}

/* Takes what the electronics say they are. */
static void take_identity(const uint8_t *packet)
{
    memcpy(identity.device_id, packet + 1, 8);
    memcpy(identity.calibration, packet + 9, 32);
    identity.capabilities = (uint16_t)wire_get(packet + 41, 2);
    identity.highest = (int32_t)wire_get(packet + 43, 4);
    identity.noisy = packet[47] != 0;
    identity.pressure_limit = 6000;
    identity.name_length = (uint8_t)strlen(board_name);
    memcpy(identity.name, board_name, identity.name_length);
}

/* Takes a sample; its time is when it arrived. */
static void take_sample(const uint8_t *packet)
{
    newest.time = board_now();
    newest.pressure = (int16_t)wire_get(packet + 1, 2);
    newest.flow = (int16_t)wire_get(packet + 3, 2);
    newest.saturated = packet[5] & 1;
    newest.lapsed = packet[5] & 2;
}

/* Takes what the bus brought. */
static void take(void)
{
    uint8_t data[DEVICE_CHUNK];
    size_t length = board_read(BOARD_BUS, data, sizeof data);
    for (size_t i = 0; i < length; i++) {
        if (wire_feed(&bus, data[i]) != WIRE_PACKET)
            continue;
        if (bus.kept[0] == 'I' && bus.length == IDENTITY_BYTES)
            take_identity(bus.kept);
        if (bus.kept[0] == 'S' && bus.length == SAMPLE_BYTES)
            take_sample(bus.kept);
    }
}

int main(void)
{
    uint8_t data[DEVICE_CHUNK], answers[DEVICE_ANSWERS];
    board_start();
    while (identity.name_length == 0) { /* the electronics are not there yet */
        order(0, 1);
        board_wait(board_now() + DEVICE_PERIOD);
        board_alive();
        take();
    }
    device_init(&device, &identity, board_now());
    uint64_t due = board_now();
    for (;;) {
        board_wait(due);
        board_alive();
        take();
        uint64_t now = board_now();
        uint16_t u_in = device.u_in;
        uint8_t u_out = device.u_out;
        size_t length = board_read(BOARD_HOST, data, sizeof data);
        length = device_step(&device, now, &newest, data, length, answers);
        if (now >= due || u_in != device.u_in || u_out != device.u_out)
            order(device.u_in, device.u_out);
        if (now >= due)
            due = due + DEVICE_PERIOD > now ? due + DEVICE_PERIOD : now + DEVICE_PERIOD;
        board_write(BOARD_HOST, answers, length);
    }
}
