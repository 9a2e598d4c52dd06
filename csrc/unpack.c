/* Take packets out of capture files: pcap and pcapng, as others and we write them.
 *
 * The blocks that describe a pcapng file's interfaces are rare, and the caller's to read. */
#include "internal.h"

#include <string.h>

enum {
    RECORD_HEAD = 16, /* of pcap */
    LEAST_BLOCK = 12, /* of pcapng */
    MOST_PACKET = 1 << 16,
    RTAC_HEADER = 12,
    TAG_DISSECTOR = 12,
    TAG_PORT_OF_SENDER = 25
};

static const char tcp_dissector[] = "mbtcp"; /* Wireshark's name for Modbus TCP */

/* The senders' ports in captures of ours. */
static const struct { uint32_t port; uint8_t side; } senders[] = {
    {50000, MD_ASKING}, {502, MD_ANSWERING}, {1, MD_FAILED}, {2, MD_NOISE},
};

/* Read 32 bits in the file's own order. */
static uint32_t number(const struct md_capture *capture, const uint8_t *at)
{
    uint32_t value = 0;
    for (int i = 0; i < 4; i++)
        value = value << 8 | at[capture->is_big_endian ? i : 3 - i];
    return value;
}

/* Return the length of what a link type puts before a frame; tags in it tell who sent the frame, and whether
 * it is Modbus TCP. */
static size_t skip_header(struct md_channel *channel, const uint8_t *packet, size_t len, uint8_t *side)
{
    uint32_t link = channel->link;
    if (link == MD_LINK_RTAC) {
        if (len > RTAC_HEADER && (packet[8] == 1 || packet[8] == 2)) /* data sent, data received */
            *side = packet[8] == 1 ? MD_ASKING : MD_ANSWERING;
        return len < RTAC_HEADER ? len : RTAC_HEADER;
    }
    if (link != MD_LINK_EXPORTED)
        return 0;
    for (size_t at = 0; at + 4 <= len;) {
        unsigned tag = md_get16(packet + at), size = md_get16(packet + at + 2);
        at += 4;
        if (tag == 0)
            return at;
        if (tag == TAG_DISSECTOR && size >= sizeof tcp_dissector - 1 && at + size <= len &&
            memcmp(packet + at, tcp_dissector, sizeof tcp_dissector - 1) == 0)
            channel->stream.is_tcp = 1;
        for (size_t i = 0; tag == TAG_PORT_OF_SENDER && size == 4 && at + 4 <= len && i < 4; i++)
            if (((uint32_t)md_get16(packet + at) << 16 | md_get16(packet + at + 2)) == senders[i].port)
                *side = senders[i].side;
        at += size;
    }
    return len;
}

/* Append a packet to its channel; 0 when there is no room for it. */
static int put(struct md_channel *channel, const uint8_t *packet, size_t len, uint64_t ticks)
{
    struct md_piece piece = {.is_after_pause = 1};
    size_t header = skip_header(channel, packet, len, &piece.side);
    if (header >= len)
        return 1;
    if (!channel->has_sides)
        piece.side = MD_EITHER_SIDE;
    uint64_t seconds = ticks / channel->ticks_per_s, rest = ticks % channel->ticks_per_s;
    uint64_t time_ns = seconds * 1000000000u + rest * 1000000000u / channel->ticks_per_s;
    piece.time_ns = (int64_t)(time_ns + (uint64_t)channel->offset_ns); /* a nonsensical one may wrap around */
    return md_stream_put(&channel->stream, packet + header, len - header, piece);
}

static int unpack_pcap(struct md_capture *capture)
{
    struct md_channel *channel = capture->channels;
    while (capture->at < capture->len) {
        const uint8_t *record = capture->bytes + capture->at;
        size_t left = capture->len - capture->at;
        if (left < RECORD_HEAD)
            return MD_CUT;
        uint32_t len = number(capture, record + 8);
        if (len > MOST_PACKET)
            return MD_NONSENSE;
        if (left < RECORD_HEAD + len)
            return MD_CUT;
        uint64_t ticks = number(capture, record) * channel->ticks_per_s + number(capture, record + 4);
        if (!put(channel, record + RECORD_HEAD, len, ticks))
            return MD_CHANNEL_FULL;
        capture->at += RECORD_HEAD + len;
    }
    return MD_UNPACKED;
}

static int unpack_pcapng(struct md_capture *capture)
{
    while (capture->at < capture->len) {
        const uint8_t *block = capture->bytes + capture->at;
        size_t left = capture->len - capture->at;
        if (left < LEAST_BLOCK)
            return MD_CUT;
        if (number(capture, block) != MD_PACKET_BLOCK)
            return MD_OTHER_BLOCK;
        uint32_t size = number(capture, block + 4);
        if (size % 4 || size < MD_PACKET_HEAD + MD_PACKET_END || size > 2 * MOST_PACKET)
            return MD_NONSENSE;
        if (left < size)
            return MD_CUT;
        uint32_t interface = number(capture, block + 8), len = number(capture, block + 20);
        if (interface >= capture->count || len > size - MD_PACKET_HEAD - MD_PACKET_END || len > MOST_PACKET ||
            number(capture, block + size - MD_PACKET_END) != size)
            return MD_NONSENSE;
        uint64_t ticks = (uint64_t)number(capture, block + 12) << 32 | number(capture, block + 16);
        if (!put(&capture->channels[interface], block + MD_PACKET_HEAD, len, ticks))
            return MD_CHANNEL_FULL;
        capture->at += size;
    }
    return MD_UNPACKED;
}

int md_unpack(struct md_capture *capture)
{
    return capture->is_pcapng ? unpack_pcapng(capture) : unpack_pcap(capture);
}
