/* The program of the ventilator's computer: a pure core that guards the lung.
 *
 * Bytes and samples go in, bytes and orders to the valves come out. The struct holds all state, no
 * pointer, no floating-point number; it may be copied. Units are the wire's: 0.01 cmH2O, mL/s,
 * 0.01 %, and microseconds of a clock that never goes back. */
#ifndef DEVICE_H
#define DEVICE_H

#include <stdbool.h>

#include "wire.h"

enum {
    DEVICE_WATCHDOG = 80000,        /* without an acceptable command, us */
    DEVICE_OLDEST_SEEN = 100,       /* reading on which a command may rest, ms */
    DEVICE_SENSOR_TIMEOUT = 50000,  /* without a valid sample, us */
    DEVICE_STUCK = 250000,          /* without a change of a reading with noise, us */
    DEVICE_NOISE_WINDOW = 40,       /* samples from which the noise is estimated */
    DEVICE_PERIOD = 5000,           /* between two steps, us */
    DEVICE_SEQUENCE_WINDOW = 65536, /* largest step of the sequence number */
    DEVICE_LARGEST_U_IN = 10000,    /* 100 % */
    DEVICE_UNKNOWN = -32768,        /* a pressure or flow that is not known */
    DEVICE_NAME = 32,
    DEVICE_CHUNK = 64,   /* most bytes that a step takes */
    DEVICE_ANSWERS = 512 /* room for what they are answered with: five of 99 bytes */
};

enum device_mode { MODE_CLOSED, MODE_READY, MODE_RUNNING, MODE_VENTED };

enum device_flag {
    FLAG_COMMANDS_STOPPED = 1,
    FLAG_OUT_OF_RANGE = 2,
    FLAG_OVERPRESSURE = 4,
    FLAG_SENSOR_LOST = 8,
    FLAG_HOST_VENTED = 16,
    FLAG_DEVICE_LATE = 32,
    FLAG_SATURATED = 64,
    FLAG_SENSOR_STUCK = 128,
    FLAG_SENSOR_NOISY = 256
};

/* In the order in which they are sent. */
enum device_counter {
    COUNT_FRAMES,
    COUNT_COMMANDS,
    COUNT_FRAMING,
    COUNT_CHECKSUM,
    COUNT_MALFORMED,
    COUNT_SESSION,
    COUNT_SEQUENCE,
    COUNT_STALE,
    COUNT_OUT_OF_RANGE,
    COUNT_NOT_ARMED,
    COUNT_WATCHDOG,
    COUNT_OVERPRESSURE,
    COUNT_SENSOR,
    COUNT_DEVICE_LATE,
    COUNTERS
};

/* One look at the sensors. */
struct sample {
    uint64_t time;    /* when it was taken, us */
    int16_t pressure; /* DEVICE_UNKNOWN if the sensor did not answer */
    int16_t flow;     /* into the lung; DEVICE_UNKNOWN if it is not measured */
    bool saturated;   /* at the upper end of the sensor's range */
    bool lapsed;      /* the electronics have vented by themselves */
};

/* What the board is, and its limits; fixed when the program starts. */
struct identity {
    uint8_t device_id[8];
    uint8_t calibration[32]; /* SHA-256 */
    char name[DEVICE_NAME];  /* UTF-8 */
    uint8_t name_length;
    bool noisy;              /* noise moves the readings, so that one that stands is stuck */
    uint16_t capabilities;   /* 1 simulated, 2 readings hold a flow */
    uint16_t pressure_limit; /* above which it vents */
    int32_t highest;         /* end of the sensor's range; INT32_MAX for none */
};

struct device {
    struct identity identity;
    struct wire_parser parser;
    uint8_t mode;
    uint8_t u_out;           /* order to the expiratory valve: 0 closed, 1 open */
    uint16_t u_in;           /* order to the inspiratory valve */
    uint16_t causes;         /* why it vented since it was last armed */
    uint16_t pressure_limit; /* of the session */
    uint32_t session, sequence;
    uint64_t fed;     /* last acceptable command, or arming */
    uint64_t valid;   /* last valid sample */
    uint64_t changed; /* last change of the reading */
    uint64_t stepped; /* last step */
    int16_t newest[DEVICE_NOISE_WINDOW]; /* last valid pressures, oldest first */
    uint8_t samples;                     /* how many of them there are */
    uint32_t counters[COUNTERS];
};

void device_init(struct device *device, const struct identity *identity, uint64_t now);
size_t device_step(struct device *device, uint64_t now, const struct sample *sample,
                   const uint8_t *data, size_t length, uint8_t *answers);

#endif
