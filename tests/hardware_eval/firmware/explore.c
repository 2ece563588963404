/* Explores the core exhaustively over a small alphabet, against a model written from PROTOCOL.md.
 *
 * Each transition is a step of the device with one sample and at most one frame. A state is what
 * matters of device and model, with times relative to now; the search goes on until there is no new
 * one. In each state, silence and a lost sensor must vent within their bounds. Exit code 1 names
 * the first disagreement. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "device.h"

enum { NORMAL = 1000, LOW_LIMIT = NORMAL, OWN = 6000, SESSION = 7, BASE = 100, T0 = 10000000 };
enum { KEY = 14, LARGEST = 1 << 16 };

enum sample_kind { GOOD, HIGH, NONE, END };
enum frame_kind {
    F_NOTHING, F_HELLO, F_HELLO_LOW, F_HELLO_OLD, F_HELLO_VERSION, F_ARM, F_COMMAND, F_STALE,
    F_FUTURE, F_RANGE, F_RANGE_OUT, F_HEARTBEAT, F_STATISTICS, F_VENT, F_FOREIGN_VENT,
    F_OLD_VENT, F_FOREIGN, F_REPEATED, F_JUMP, F_FAR, FRAMES
};

/* What the specification says the device is. */
struct model {
    unsigned mode, u_in, u_out, causes, limit;
    uint32_t fed, valid; /* ages, us */
};

/* What it must answer: kind, or for a refusal 0x8300 + reason; 0 for nothing. */
static unsigned answer;

static struct { struct device device; struct model model; } states[LARGEST];
static int count;
static long transitions;

/* The model vents. */
static void vented(struct model *m, unsigned causes)
{
    m->mode = m->mode == MODE_CLOSED ? MODE_CLOSED : MODE_VENTED;
    m->u_in = 0;
    m->u_out = 1;
    m->causes |= causes;
}

/* Causes of venting that the sensor gives. */
static unsigned danger(const struct model *m, enum sample_kind sample)
{
    unsigned pressure = sample == HIGH ? NORMAL + 1 : NORMAL;
    return ((sample != NONE && pressure > m->limit) || sample == END ? 4u : 0u) |
           (m->valid > 50000 ? 8u : 0u);
}

/* One step by the "order of checks" and the "duties" of PROTOCOL.md. */
static void model_step(struct model *m, uint32_t dt, enum sample_kind sample, enum frame_kind frame)
{
    bool open = m->mode != MODE_CLOSED;
    m->fed += dt;
    m->valid = sample == NONE ? m->valid + dt : 0;
    if (m->mode == MODE_RUNNING) {
        unsigned causes = danger(m, sample);
        if (m->fed > 80000)
            causes |= dt > 40000 ? 1 | 32 : 1;
        if (causes)
            vented(m, causes);
    }
    answer = 0x82;
    switch (frame) {
    case F_NOTHING: answer = 0; return;
    case F_VENT:
    case F_FOREIGN_VENT:
    case F_OLD_VENT: vented(m, 16); return;
    case F_HELLO_VERSION: answer = 0x8301; return;
    case F_HELLO_OLD:
        if (open) {
            answer = 0x8303;
            return;
        }
        /* fall through */
    case F_HELLO:
    case F_HELLO_LOW:
        vented(m, 0);
        m->mode = MODE_READY;
        m->limit = frame == F_HELLO_LOW ? LOW_LIMIT : OWN;
        answer = 0x81;
        return;
    case F_FOREIGN: answer = 0x8302; return;
    case F_REPEATED:
    case F_FAR: answer = open ? 0x8303 : 0x8302; return;
    default: break;
    }
    if (!open) {
        answer = 0x8302;
        return;
    }
    switch (frame) {
    case F_STATISTICS: answer = 0x84; return;
    case F_ARM: {
        unsigned causes = danger(m, sample);
        if (causes) {
            vented(m, causes);
            answer = 0x8307;
            return;
        }
        *m = (struct model){MODE_RUNNING, 0, 1, 0, m->limit, 0, m->valid};
        return;
    }
    case F_RANGE:
    case F_RANGE_OUT: vented(m, 2); answer = 0x8306; return;
    case F_COMMAND:
    case F_STALE:
    case F_FUTURE:
        if (m->mode != MODE_RUNNING)
            answer = 0x8304;
        else if (frame != F_COMMAND)
            answer = 0x8305;
        else
            m->u_in = 3000, m->u_out = 0, m->fed = 0;
        return;
    default: return; /* heartbeats, of the next number or one far above */
    }
}

/* The frame of a kind; returns its length. */
static size_t make(const struct device *device, uint64_t now, enum frame_kind kind, uint8_t *out)
{
    uint8_t packet[32], *end = packet + 9;
    uint32_t session = SESSION, sequence = device->sequence + 1, ms = (uint32_t)(now / 1000);
    unsigned u_in = 3000, u_out = 0;
    packet[0] = 0x03;
    switch (kind) {
    case F_NOTHING:
    case FRAMES: return 0;
    case F_HELLO_OLD: sequence = device->sequence; /* fall through */
    case F_HELLO:
    case F_HELLO_LOW:
    case F_HELLO_VERSION:
        packet[0] = 0x01;
        end = wire_put(end, kind == F_HELLO_VERSION ? 2 : 1, 1);
        end = wire_put(end, kind == F_HELLO_LOW ? LOW_LIMIT : 0xFFFE, 2);
        break;
    case F_ARM: packet[0] = 0x02; break;
    case F_JUMP: sequence = device->sequence + 65536; packet[0] = 0x04; break;
    case F_HEARTBEAT: packet[0] = 0x04; break;
    case F_STATISTICS: packet[0] = 0x06; break;
    case F_OLD_VENT: sequence = device->sequence; packet[0] = 0x05; break;
    case F_FOREIGN_VENT: session ^= 1; packet[0] = 0x05; break;
    case F_VENT: packet[0] = 0x05; break;
    case F_STALE: ms -= 101; break;
    case F_FUTURE: ms += 1; break;
    case F_RANGE: u_in = 10001; ms -= 5000; break;
    case F_RANGE_OUT: u_out = 2; break;
    case F_FOREIGN: session ^= 1; break;
    case F_REPEATED: sequence = device->sequence; break;
    case F_FAR: sequence = device->sequence + 65537; break;
    case F_COMMAND: ms -= 100; break;
    }
    if (packet[0] == 0x03)
        end = wire_put(wire_put(wire_put(end, u_in, 2), u_out, 1), ms, 4);
    wire_put(wire_put(packet + 1, session, 4), sequence, 4);
    return wire_frame(packet, (size_t)(end - packet), out);
}

/* A sample of a kind. */
static struct sample look(uint64_t now, enum sample_kind kind)
{
    struct sample sample = {now, NORMAL, DEVICE_UNKNOWN, kind == END, false};
    if (kind == HIGH)
        sample.pressure = NORMAL + 1;
    if (kind == NONE)
        sample.pressure = DEVICE_UNKNOWN;
    return sample;
}

/* Ends the program with what differs. */
static void differs(const char *what, unsigned frame, unsigned sample, unsigned got, unsigned want)
{
    printf("%s: %#x, not %#x; frame %u, sample %u, state %d\n", what, got, want, frame, sample,
           count);
    exit(1);
}

/* Makes times relative and forgets what cannot matter; see KEY. */
static void normalise(struct device *d, struct model *m)
{
    uint64_t fed = d->stepped - d->fed, valid = d->stepped - d->valid;
    if (d->mode != MODE_RUNNING)
        fed = m->fed = 0;
    m->valid = m->valid > 60000 ? 60000 : m->valid;
    valid = valid > 60000 ? 60000 : valid;
    d->stepped = T0;
    d->fed = T0 - fed;
    d->valid = d->changed = T0 - valid;
    if (d->mode != MODE_CLOSED)
        d->sequence = BASE;
    memset(&d->parser, 0, sizeof d->parser);
    memset(d->counters, 0, sizeof d->counters);
    for (int i = 0; i < DEVICE_NOISE_WINDOW; i++) /* values of 10.00 and 10.01 are never noisy */
        d->newest[i] = NORMAL;
    d->samples = DEVICE_NOISE_WINDOW;
}

/* Adds a state unless it is known. */
static void visit(struct device d, struct model m)
{
    static int table[4 * LARGEST];
    normalise(&d, &m);
    uint64_t key[KEY] = {d.mode, d.u_in, d.u_out, d.causes, d.pressure_limit, d.session, T0 - d.fed,
                         T0 - d.valid, m.mode, m.u_in, m.causes, m.limit, m.fed, m.valid};
    static uint64_t keys[LARGEST][KEY];
    uint64_t hash = 14695981039346656037u;
    for (int i = 0; i < KEY; i++)
        hash = (hash ^ key[i]) * 1099511628211u;
    for (size_t at = hash >> 46;; at = (at + 1) % (4 * LARGEST)) {
        if (table[at] == 0) {
            if (count == LARGEST)
                differs("states without end", 0, 0, LARGEST, 0);
            memcpy(keys[count], key, sizeof key);
            states[count].device = d;
            states[count].model = m;
            table[at] = ++count;
            return;
        }
        if (memcmp(keys[table[at] - 1], key, sizeof key) == 0)
            return;
    }
}

/* Steps device and model alike, and compares them. */
static void transition(int from, uint32_t dt, enum sample_kind kind, enum frame_kind frame)
{
    struct device d = states[from].device;
    struct model m = states[from].model;
    struct wire_parser heard = {0};
    uint8_t data[64], out[DEVICE_ANSWERS];
    uint64_t now = d.stepped + dt;
    struct sample sample = look(now, kind);
    uint32_t before = d.sequence;
    size_t sent = device_step(&d, now, &sample, data, make(&d, now, frame, data), out);
    unsigned got = 0;
    for (size_t i = 0; i < sent; i++)
        if (wire_feed(&heard, out[i]) == WIRE_PACKET)
            got = heard.kept[0] == 0x83 ? 0x8300u + heard.kept[9] : heard.kept[0];
    model_step(&m, dt, kind, frame);
    transitions++;
    if (got != answer)
        differs("answer", frame, kind, got, answer);
    if (d.mode != m.mode)
        differs("mode", frame, kind, d.mode, m.mode);
    if (d.u_in != m.u_in || d.u_out != m.u_out)
        differs("valves", frame, kind, d.u_in * 2u + d.u_out, m.u_in * 2 + m.u_out);
    if (d.causes != m.causes)
        differs("causes", frame, kind, d.causes, m.causes);
    if (got == 0x82 && wire_get(heard.kept + 21, 2) != m.u_in)
        differs("u_in as told", frame, kind, (unsigned)wire_get(heard.kept + 21, 2), m.u_in);
    bool consumes = answer != 0 && answer != 0x8301 && answer != 0x8302 && answer != 0x8303 &&
                    frame != F_FOREIGN_VENT && frame != F_OLD_VENT && m.mode != MODE_CLOSED;
    uint32_t step = frame == F_JUMP ? 65536 : frame == F_HELLO_OLD ? 0 : 1;
    if (d.sequence - before != (consumes ? step : 0))
        differs("number consumed", frame, kind, d.sequence - before, step);
    visit(d, m);
}

/* Steps until the device is vented; returns the time that takes, us. */
static uint32_t vents_after(struct device d, enum sample_kind kind, uint32_t most)
{
    uint8_t out[DEVICE_ANSWERS];
    uint32_t time = 0;
    while (d.mode == MODE_RUNNING && time <= most) {
        time += DEVICE_PERIOD;
        struct sample sample = look(d.stepped + DEVICE_PERIOD, kind);
        device_step(&d, d.stepped + DEVICE_PERIOD, &sample, NULL, 0, out);
    }
    if (d.u_in != 0 || d.u_out != 1)
        time = most + 1;
    return time;
}

/* Whether the next frame is read, whatever bytes came before. */
static void garbage(void)
{
    static const uint8_t alphabet[] = {0x00, 0x01, 0x02, 0x0E, 0xFF};
    for (int word = 0; word < 78125; word++) { /* 5 ^ 7 */
        struct device d = states[0].device;
        uint8_t data[64], out[DEVICE_ANSWERS];
        size_t length = 0, sent;
        for (int rest = word, i = 0; i < 7; i++, rest /= 5)
            data[length++] = alphabet[rest % 5];
        length += make(&d, d.stepped, F_HEARTBEAT, data + length);
        struct sample sample = look(d.stepped, GOOD);
        sent = device_step(&d, d.stepped, &sample, data, length, out);
        if (sent == 0)
            differs("a frame after garbage", F_HEARTBEAT, GOOD, 0, 0x8302);
    }
}

int main(void)
{
    struct identity identity = {.pressure_limit = OWN, .highest = INT32_MAX, .name_length = 1};
    struct device device;
    static const struct { uint32_t after; enum sample_kind kind; } bounds[] = {
        {85000, GOOD}, {55000, NONE}, {5000, END}};
    uint32_t longest[3] = {0};
    device_init(&device, &identity, T0);
    device.session = SESSION;
    visit(device, (struct model){MODE_CLOSED, 0, 1, 0, OWN, 0, 0});
    for (int from = 0; from < count; from++) {
        for (unsigned frame = 0; frame < FRAMES; frame++)
            for (unsigned kind = GOOD; kind <= END; kind++)
                transition(from, DEVICE_PERIOD, kind, frame);
        transition(from, 0, GOOD, F_COMMAND);
        transition(from, 90000, GOOD, F_COMMAND); /* held up: too late, though it rests on now */
        transition(from, 35000, NONE, F_NOTHING);
        for (int i = 0; i < 3; i++) {
            uint32_t time = vents_after(states[from].device, bounds[i].kind, bounds[i].after);
            longest[i] = time > longest[i] ? time : longest[i];
            if (time > bounds[i].after)
                differs("not vented in time", F_NOTHING, bounds[i].kind, time, bounds[i].after);
        }
    }
    garbage();
    printf("%d states, %ld transitions; vented at the latest after %u us of silence, %u without a "
           "sensor, %u at its end\n",
           count, transitions, longest[0], longest[1], longest[2]);
    return 0;
}
