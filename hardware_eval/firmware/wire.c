#include "wire.h"

#include <stdbool.h>

/* Writes a number of so many bytes, little-endian; returns where the next one goes. */
uint8_t *wire_put(uint8_t *to, uint64_t value, unsigned bytes)
{
    for (unsigned i = 0; i < bytes; i++)
        *to++ = (uint8_t)(value >> 8 * i);
    return to;
}

/* Reads a number of so many bytes, little-endian. */
uint64_t wire_get(const uint8_t *from, unsigned bytes)
{
    uint64_t value = 0;
    for (unsigned i = 0; i < bytes; i++)
        value |= (uint64_t)from[i] << 8 * i;
    return value;
}

/* CRC-32 of IEEE 802.3, as in zlib. Bit by bit: a packet takes less than 0.1 ms at 25 MHz. */
static uint32_t crc32(const uint8_t *data, size_t length)
{
    uint32_t crc = 0xFFFFFFFFu;
    while (length--) {
        crc ^= *data++;
        for (int bit = 0; bit < 8; bit++)
            crc = crc >> 1 ^ (crc & 1u ? 0xEDB88320u : 0u);
    }
    return ~crc;
}

/* Undoes COBS in place; false if the bytes are none. They hold no zero. */
static bool unstuff(uint8_t *data, uint8_t *length)
{
    unsigned from = 0, to = 0, end = *length;
    while (from < end) {
        unsigned code = data[from++];
        if (from + code - 1 > end)
            return false;
        for (unsigned i = 1; i < code; i++)
            data[to++] = data[from++];
        if (code < 0xFF && from < end)
            data[to++] = 0;
    }
    *length = (uint8_t)to;
    return true;
}

/* Decodes what lay between two zero bytes. */
static enum wire_event finish(struct wire_parser *parser)
{
    if (!unstuff(parser->kept, &parser->length))
        return WIRE_FRAMING;
    if (parser->length < 1 + 4 + 4 + WIRE_CRC)
        return WIRE_CHECKSUM;
    parser->length -= WIRE_CRC;
    uint32_t sent = (uint32_t)wire_get(parser->kept + parser->length, WIRE_CRC);
    return sent == crc32(parser->kept, parser->length) ? WIRE_PACKET : WIRE_CHECKSUM;
}

/* Takes one byte; says what it completed. */
enum wire_event wire_feed(struct wire_parser *parser, uint8_t byte)
{
    if (byte == 0) {
        bool whole = parser->place == WIRE_INSIDE;
        parser->place = WIRE_BETWEEN;
        return whole ? finish(parser) : WIRE_NOTHING;
    }
    if (parser->place == WIRE_HUNTING)
        return WIRE_NOTHING;
    if (parser->place == WIRE_BETWEEN) {
        parser->place = WIRE_INSIDE;
        parser->length = 0;
    }
    if (parser->length == WIRE_LONGEST_FRAME) {
        parser->place = WIRE_HUNTING;
        return WIRE_FRAMING;
    }
    parser->kept[parser->length++] = byte;
    return WIRE_NOTHING;
}

/* Puts the CRC behind a packet, which has room for it, and writes its frame: at most
 * length + WIRE_CRC + 3 bytes. A packet is at most WIRE_LONGEST_PACKET bytes with its CRC, so that
 * no block of COBS is ever full. Returns the length of the frame. */
size_t wire_frame(uint8_t *packet, size_t length, uint8_t *out)
{
    wire_put(packet + length, crc32(packet, length), WIRE_CRC);
    length += WIRE_CRC;
    uint8_t *code = out + 1, *to = out + 2;
    out[0] = 0;
    for (size_t i = 0; i < length; i++) {
        if (packet[i] != 0) {
            *to++ = packet[i];
            continue;
        }
        *code = (uint8_t)(to - code);
        code = to++;
    }
    *code = (uint8_t)(to - code);
    *to++ = 0;
    return (size_t)(to - out);
}
