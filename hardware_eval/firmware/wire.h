/* Frames of the wire: COBS between zero bytes, CRC-32, and a parser that takes one byte at a time.
 *
 * PROTOCOL.md specifies them. No memory beyond one frame, no state beyond the struct. */
#ifndef WIRE_H
#define WIRE_H

#include <stddef.h>
#include <stdint.h>

enum {
    WIRE_LONGEST_PACKET = 254,
    WIRE_LONGEST_FRAME = WIRE_LONGEST_PACKET + 1, /* without its zero bytes */
    WIRE_CRC = 4,
};

/* Place in the stream of bytes. */
enum wire_place { WIRE_HUNTING, WIRE_BETWEEN, WIRE_INSIDE };

/* What a byte completed. */
enum wire_event { WIRE_NOTHING, WIRE_PACKET, WIRE_FRAMING, WIRE_CHECKSUM };

/* The parser. After WIRE_PACKET, the first `length` bytes of `kept` are header and body. */
struct wire_parser {
    uint8_t place;
    uint8_t length;
    uint8_t kept[WIRE_LONGEST_FRAME];
};

enum wire_event wire_feed(struct wire_parser *parser, uint8_t byte);
size_t wire_frame(uint8_t *packet, size_t length, uint8_t *out);

uint8_t *wire_put(uint8_t *to, uint64_t value, unsigned bytes);
uint64_t wire_get(const uint8_t *from, unsigned bytes);

#endif
