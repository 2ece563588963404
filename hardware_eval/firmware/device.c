#include "device.h"

#include <string.h>

enum { VERSION = 1, FIRMWARE_MAJOR = 1, FIRMWARE_MINOR = 0, FIRMWARE_PATCH = 0 };

enum kind {
    HELLO = 0x01,
    ARM,
    COMMAND,
    HEARTBEAT,
    VENT,
    STATISTICS,
    WELCOME = 0x81,
    READING,
    REFUSAL,
    COUNTED
};

enum reason {
    REASON_VERSION = 1,
    REASON_SESSION,
    REASON_SEQUENCE,
    REASON_NOT_ARMED,
    REASON_STALE,
    REASON_OUT_OF_RANGE,
    REASON_UNSAFE,
    REASON_SENSOR_RANGE
};

enum { HEADER = 9, OWN_LIMIT = 0xFFFF };

/* An answer on its way: the longest is a welcome. */
struct answer {
    uint8_t packet[HEADER + 51 + DEVICE_NAME + WIRE_CRC];
    uint8_t *end;
};

/* Starts vented, without a session. */
void device_init(struct device *device, const struct identity *identity, uint64_t now)
{
    memset(device, 0, sizeof *device);
    device->identity = *identity;
    device->pressure_limit = identity->pressure_limit;
    device->u_out = 1;
    device->valid = device->changed = device->stepped = now;
}

/* Closes the inspiratory valve and opens the expiratory one; remembers why. */
static void vent(struct device *device, unsigned causes)
{
    static const struct {
        uint16_t flags;
        uint8_t counter;
    } counted[] = {
        {FLAG_COMMANDS_STOPPED, COUNT_WATCHDOG}, {FLAG_OVERPRESSURE, COUNT_OVERPRESSURE},
        {FLAG_SENSOR_LOST, COUNT_SENSOR},        {FLAG_SENSOR_STUCK, COUNT_SENSOR},
        {FLAG_SENSOR_NOISY, COUNT_SENSOR},       {FLAG_DEVICE_LATE, COUNT_DEVICE_LATE},
    };
    if (device->mode == MODE_RUNNING)
        for (size_t i = 0; i < sizeof counted / sizeof *counted; i++)
            if (causes & counted[i].flags)
                device->counters[counted[i].counter]++;
    if (device->mode != MODE_CLOSED)
        device->mode = MODE_VENTED;
    device->u_in = 0;
    device->u_out = 1;
    device->causes |= (uint16_t)causes;
}

/* Remembers a sample, if it is valid and new. */
static void remember(struct device *device, const struct sample *sample)
{
    if (sample->pressure == DEVICE_UNKNOWN || sample->time <= device->valid)
        return;
    device->valid = sample->time;
    if (device->samples == 0 || sample->pressure != device->newest[device->samples - 1])
        device->changed = sample->time;
    if (device->samples == DEVICE_NOISE_WINDOW)
        memmove(device->newest, device->newest + 1, --device->samples * sizeof *device->newest);
    device->newest[device->samples++] = sample->pressure;
}

/* Whether the last samples scatter by more than 1 cmH2O (SD). Second differences leave out what the
 * lung does, and their median the jumps at commands. For white noise, the median of their absolute
 * values is 1.652 SD. */
static bool noisy(const struct device *device)
{
    enum { N = DEVICE_NOISE_WINDOW - 2, LARGEST = 330 }; /* 2 x 1.652 x 100 */
    int32_t sorted[N];
    if (device->samples < DEVICE_NOISE_WINDOW)
        return false;
    for (int i = 0; i < N; i++) {
        const int16_t *p = device->newest + i;
        int32_t difference = p[0] - 2 * p[1] + p[2];
        int k = i;
        difference = difference < 0 ? -difference : difference;
        for (; k > 0 && sorted[k - 1] > difference; k--)
            sorted[k] = sorted[k - 1];
        sorted[k] = difference;
    }
    return sorted[N / 2 - 1] + sorted[N / 2] > LARGEST;
}

/* Causes of venting that the sensor gives. */
static unsigned dangers(const struct device *device, const struct sample *sample)
{
    unsigned causes = 0;
    if (sample->pressure > (int32_t)device->pressure_limit || sample->saturated)
        causes |= FLAG_OVERPRESSURE;
    if (sample->lapsed)
        causes |= FLAG_DEVICE_LATE;
    if (device->stepped > device->valid + DEVICE_SENSOR_TIMEOUT)
        causes |= FLAG_SENSOR_LOST;
    if (device->identity.noisy && device->valid - device->changed > DEVICE_STUCK)
        causes |= FLAG_SENSOR_STUCK;
    if (noisy(device))
        causes |= FLAG_SENSOR_NOISY;
    return causes;
}

/* Flags of an answer. */
static unsigned flags(const struct device *device, const struct sample *sample)
{
    return device->causes | (sample->saturated ? FLAG_SATURATED : 0u);
}

/* Adds a number to an answer. */
static void add(struct answer *answer, uint64_t value, unsigned bytes)
{
    answer->end = wire_put(answer->end, value, bytes);
}

/* Adds bytes to an answer. */
static void add_bytes(struct answer *answer, const void *from, size_t length)
{
    memcpy(answer->end, from, length);
    answer->end += length;
}

/* Answers with the device's state. */
static void answer_reading(struct answer *answer, const struct device *device,
                           const struct sample *sample)
{
    answer->packet[0] = READING;
    add(answer, sample->time, 8);
    add(answer, (uint16_t)sample->pressure, 2);
    add(answer, (uint16_t)sample->flow, 2);
    add(answer, device->u_in, 2);
    add(answer, device->u_out, 1);
    add(answer, device->mode, 1);
    add(answer, flags(device, sample), 2);
}

/* Refuses. */
static void refuse(struct answer *answer, const struct device *device, const struct sample *sample,
                   enum reason reason)
{
    answer->packet[0] = REFUSAL;
    add(answer, reason, 1);
    add(answer, device->mode, 1);
    add(answer, flags(device, sample), 2);
}

/* Opens a session: vents, and tells who it is. */
static void open_session(struct answer *answer, struct device *device, uint32_t session,
                         uint32_t sequence, unsigned limit)
{
    const struct identity *identity = &device->identity;
    vent(device, 0);
    device->mode = MODE_READY;
    device->session = session;
    device->sequence = sequence;
    device->pressure_limit = identity->pressure_limit;
    if (limit != OWN_LIMIT && limit < identity->pressure_limit)
        device->pressure_limit = (uint16_t)limit;
    answer->packet[0] = WELCOME;
    add(answer, VERSION, 1);
    add(answer, FIRMWARE_MAJOR, 1);
    add(answer, FIRMWARE_MINOR, 1);
    add(answer, FIRMWARE_PATCH, 1);
    add(answer, identity->capabilities, 2);
    add(answer, DEVICE_WATCHDOG / 1000, 2);
    add(answer, device->pressure_limit, 2);
    add_bytes(answer, identity->device_id, sizeof identity->device_id);
    add_bytes(answer, identity->calibration, sizeof identity->calibration);
    add(answer, identity->name_length, 1);
    add_bytes(answer, identity->name, identity->name_length);
}

/* Begins a run, unless a cause of venting lasts. */
static void arm(struct answer *answer, struct device *device, const struct sample *sample)
{
    if (device->pressure_limit >= device->identity.highest) {
        refuse(answer, device, sample, REASON_SENSOR_RANGE);
        return;
    }
    unsigned causes = dangers(device, sample);
    if (causes) {
        vent(device, causes);
        refuse(answer, device, sample, REASON_UNSAFE);
        return;
    }
    device->mode = MODE_RUNNING;
    device->fed = device->stepped;
    device->u_in = 0;
    device->u_out = 1;
    device->causes = 0;
    answer_reading(answer, device, sample);
}

/* Sets the valves, if the command is acceptable. */
static void command(struct answer *answer, struct device *device, const struct sample *sample,
                    const uint8_t *body)
{
    unsigned u_in = (unsigned)wire_get(body, 2), u_out = body[2];
    uint32_t age = (uint32_t)(device->stepped / 1000) - (uint32_t)wire_get(body + 3, 4);
    if (u_in > DEVICE_LARGEST_U_IN || u_out > 1) {
        vent(device, FLAG_OUT_OF_RANGE);
        device->counters[COUNT_OUT_OF_RANGE]++;
        refuse(answer, device, sample, REASON_OUT_OF_RANGE);
    } else if (device->mode != MODE_RUNNING) {
        device->counters[COUNT_NOT_ARMED]++;
        refuse(answer, device, sample, REASON_NOT_ARMED);
    } else if (age > DEVICE_OLDEST_SEEN) { /* also a time ahead of the device's own */
        device->counters[COUNT_STALE]++;
        refuse(answer, device, sample, REASON_STALE);
    } else {
        device->counters[COUNT_COMMANDS]++;
        device->u_in = (uint16_t)u_in;
        device->u_out = (uint8_t)u_out;
        device->fed = device->stepped;
        answer_reading(answer, device, sample);
    }
}

/* Length of the body of a host's message; -1 for a kind that no host sends. */
static int body_length(uint8_t kind)
{
    switch (kind) {
    case HELLO: return 3;
    case COMMAND: return 7;
    case ARM:
    case HEARTBEAT:
    case VENT:
    case STATISTICS: return 0;
    default: return -1;
    }
}

/* Does what one intact packet of a host asks. */
static void obey(struct answer *answer, struct device *device, const struct sample *sample,
                 const uint8_t *packet)
{
    const uint8_t *body = packet + HEADER;
    uint32_t session = (uint32_t)wire_get(packet + 1, 4);
    uint32_t sequence = (uint32_t)wire_get(packet + 5, 4);
    bool known = device->mode != MODE_CLOSED && session == device->session;
    bool fresh = sequence > device->sequence &&
                 sequence - device->sequence <= DEVICE_SEQUENCE_WINDOW;

    if (packet[0] == VENT) { /* from whomever, and whenever: it is always safe */
        if (known && fresh)
            device->sequence = sequence;
        vent(device, FLAG_HOST_VENTED);
        answer_reading(answer, device, sample);
        return;
    }
    if (packet[0] == HELLO && body[0] != VERSION) {
        refuse(answer, device, sample, REASON_VERSION);
        return;
    }
    if (packet[0] == HELLO && !known) {
        open_session(answer, device, session, sequence, (unsigned)wire_get(body + 1, 2));
        return;
    }
    if (!known) {
        device->counters[COUNT_SESSION]++;
        refuse(answer, device, sample, REASON_SESSION);
        return;
    }
    if (!fresh) {
        device->counters[COUNT_SEQUENCE]++;
        refuse(answer, device, sample, REASON_SEQUENCE);
        return;
    }
    device->sequence = sequence;
    switch (packet[0]) {
    case HELLO:
        open_session(answer, device, session, sequence, (unsigned)wire_get(body + 1, 2));
        break;
    case ARM: arm(answer, device, sample); break;
    case COMMAND: command(answer, device, sample, body); break;
    case STATISTICS:
        answer->packet[0] = COUNTED;
        for (int i = 0; i < COUNTERS; i++)
            add(answer, device->counters[i], 4);
        break;
    default: answer_reading(answer, device, sample);
    }
}

/* Takes one byte of the host; returns the length of what it is answered with. */
static size_t hear(struct device *device, const struct sample *sample, uint8_t byte, uint8_t *out)
{
    const uint8_t *packet = device->parser.kept;
    struct answer answer;
    switch (wire_feed(&device->parser, byte)) {
    case WIRE_NOTHING: return 0;
    case WIRE_FRAMING: device->counters[COUNT_FRAMING]++; return 0;
    case WIRE_CHECKSUM: device->counters[COUNT_CHECKSUM]++; return 0;
    case WIRE_PACKET: break;
    }
    if (device->parser.length - HEADER != body_length(packet[0])) {
        device->counters[COUNT_MALFORMED]++;
        return 0;
    }
    device->counters[COUNT_FRAMES]++;
    memcpy(answer.packet, packet, HEADER); /* its session and sequence number */
    answer.end = answer.packet + HEADER;
    obey(&answer, device, sample, packet);
    return wire_frame(answer.packet, (size_t)(answer.end - answer.packet), out);
}

/* Guards the lung, then does what arrived. The guards come first: a command that arrives after the
 * watchdog's time is too late, however long the device itself was held up.
 *
 * `data` are at most DEVICE_CHUNK bytes; more go in further steps at the same time with the same
 * sample. `answers` has room for DEVICE_ANSWERS bytes; returns how many are to be sent. The valves
 * must take `u_in` and `u_out` at once. */
size_t device_step(struct device *device, uint64_t now, const struct sample *sample,
                   const uint8_t *data, size_t length, uint8_t *answers)
{
    uint64_t held_up = now - device->stepped;
    size_t sent = 0;
    device->stepped = now;
    remember(device, sample);
    if (device->mode == MODE_RUNNING) {
        unsigned causes = dangers(device, sample);
        if (now - device->fed > DEVICE_WATCHDOG) {
            causes |= FLAG_COMMANDS_STOPPED;
            causes |= held_up > DEVICE_WATCHDOG / 2 ? FLAG_DEVICE_LATE : 0u;
        }
        if (causes)
            vent(device, causes);
    }
    for (size_t i = 0; i < length; i++)
        sent += hear(device, sample, data[i], answers + sent);
    return sent;
}
