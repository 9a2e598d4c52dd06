/* Decode hostile capture files into columns: read packets, split them into frames, decode the frames.
 *
 * An input is a byte with the kind of file, link type and clock, a byte with the size of buffers, and the
 * file's packets: pcap without its header, or pcapng. */
#include "fuzz.h"

enum { HEADER = 2, MOST = 4096, ROWS = 64, PLACES = 16, CHANNELS = 2, PCAP_RECORD = 16, PCAPNG_HEAD = 28,
      PCAPNG_BLOCK = 32, RTAC_HEAD = 12 };

struct reader {
    struct md_capture capture;
    struct md_channel channels[CHANNELS];
    struct md_decoder decoders[CHANNELS];
    struct md_known known[CHANNELS][PLACES];
    uint64_t rows, bytes; /* number of decoded rows; number of bytes in frames and junk */
};

static const struct md_field fields[] = {{.at = 0, .multiplier = 1, .divisor = 1},
                                         {.at = 1, .format = MD_U32, .multiplier = 1, .divisor = 1}};
static const struct md_block block = {.fields = fields, .count = 2};

static void decode(struct reader *reader, int i)
{
    static int64_t time[ROWS], sent[ROWS], uncertainty[ROWS];
    static uint16_t drive[ROWS], reg[ROWS], status[ROWS];
    static double value[ROWS];
    static uint8_t valid[ROWS / 8];
    struct md_columns rows = {.time = time, .sent = sent, .uncertainty = uncertainty, .drive = drive,
                              .reg = reg,
                              .status = status, .value = value, .valid = valid, .room = ROWS};
    struct md_decoder *decoder = &reader->decoders[i];
    for (int state; (state = md_decode(decoder, &reader->channels[i].stream, &rows)) != MD_ALL_DECODED;) {
        const struct md_span *span = &decoder->span;
        if (state == MD_NO_ROOM) {
            must(ROWS - rows.rows < (size_t)block.count);
            reader->rows += rows.rows;
            rows.rows = 0;
            continue;
        }
        must(state == MD_UNKNOWN && (span->kind == MD_REQUEST || span->kind == MD_EITHER));
        if (!md_know(decoder, span->framing, &span->message, span->message.address ? &block : NULL)) {
            must(4 * decoder->taken >= 3 * PLACES);
            memset(reader->known[i], 0, sizeof reader->known[i]);
            decoder->taken = 0;
        }
    }
    reader->rows += rows.rows;
    for (size_t row = 0; row < rows.rows; row++)
        must((valid[row / 8] >> row % 8 & 1) == (status[row] == 0) &&
             (status[row] == 0 || uncertainty[row] == 0));
}

/* Check that every byte is part of a frame or counted as junk, and that only exchanges give rows. */
static void check_counts(const struct reader *reader)
{
    uint64_t junk = 0, frames = 0, exchanges = 0;
    for (size_t i = 0; i < reader->capture.count; i++) {
        const struct md_decoder *decoder = &reader->decoders[i];
        must(2 * decoder->exchanges + decoder->strays <= decoder->frames);
        junk += decoder->junk;
        frames += decoder->frames;
        exchanges += decoder->exchanges;
    }
    must(junk + 5 * frames <= reader->bytes && junk + MD_MOST_FRAME * frames >= reader->bytes);
    must(reader->rows <= (uint64_t)block.count * frames && exchanges <= frames);
}

static void read_all(struct reader *reader)
{
    struct md_capture *capture = &reader->capture;
    int state = MD_CHANNEL_FULL;
    while (state == MD_CHANNEL_FULL) {
        size_t at = capture->at;
        state = md_unpack(capture);
        must(capture->at >= at && capture->at <= capture->len);
        int is_stuck = state == MD_CHANNEL_FULL && capture->at == at;
        for (size_t i = 0; i < capture->count; i++) {
            struct md_stream *stream = &reader->channels[i].stream;
            size_t before = stream->len;
            stream->is_all = state != MD_CHANNEL_FULL;
            decode(reader, (int)i);
            md_stream_forget(stream, &reader->decoders[i].splitter);
            must(stream->len <= MD_MOST_FRAME && stream->count <= stream->len &&
                 (!stream->is_all || stream->len == 0));
            reader->bytes += before - stream->len;
            is_stuck &= stream->len == before;
        }
        if (is_stuck)
            return; /* here the buffer may be too small for a packet; the library's is not */
    }
    must((state == MD_UNPACKED) == (capture->at == capture->len));
    must(state == MD_UNPACKED || state == MD_CUT || state == MD_NONSENSE ||
         (state == MD_OTHER_BLOCK && capture->is_pcapng));
    check_counts(reader);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static const uint32_t links[] = {MD_LINK_RTAC, MD_LINK_EXPORTED, 147, 147};
    static struct reader reader;
    if (size < HEADER || size > MOST)
        return 0;
    reader = (struct reader){.capture = {.len = size - HEADER, .is_pcapng = data[0] & 1,
                                         .is_big_endian = data[0] >> 1 & 1,
                                         .channels = reader.channels, .count = data[0] & 1 ? CHANNELS : 1}};
    uint8_t *file = exact_copy(data + HEADER, size - HEADER);
    reader.capture.bytes = file;
    size_t room = MD_MOST_FRAME + 512 + 16u * data[1];
    for (int i = 0; i < CHANNELS; i++) {
        struct md_stream stream = {.bytes = malloc(room), .pieces = malloc(room * sizeof(struct md_piece)),
                                   .room = room, .most = room};
        reader.channels[i] = (struct md_channel){.link = links[data[0] >> 2 & 3],
                                                 .has_sides = data[0] >> 4 & 1,
                                                 .ticks_per_s = data[0] & 0x20 ? 1u << 20 : 1000000000u,
                                                     .stream = stream};
        reader.decoders[i] = (struct md_decoder){.known = reader.known[i], .places = PLACES};
    }
    read_all(&reader);
    for (int i = 0; i < CHANNELS; i++) {
        free(reader.channels[i].stream.bytes);
        free(reader.channels[i].stream.pieces);
    }
    free(file);
    return 0;
}

static void put_number(uint8_t *at, int is_big_endian, uint32_t value)
{
    for (int i = 0; i < 4; i++)
        at[i] = (uint8_t)(value >> 8 * (is_big_endian ? 3 - i : i));
}

/* Return the position of the frame in a packet of this link type, after the packet's own header. */
static size_t frame_in(const uint8_t *packet, size_t len, int link)
{
    if (link == 0) /* RTAC serial */
        return len < RTAC_HEAD ? len : RTAC_HEAD;
    size_t at = 0;
    while (link == 1 && at + 4 <= len) { /* exported PDU: skip its tags */
        size_t tag = (size_t)(packet[at] << 8 | packet[at + 1]),
            size = (size_t)(packet[at + 2] << 8 | packet[at + 3]);
        at += 4 + (tag ? size : 0);
        if (tag == 0)
            break;
    }
    return at < len ? at : len;
}

/* Select the frame of a packet, and repair the lengths of earlier packets. The frame's length is fixed. */
int find_wire(uint8_t *data, size_t size, unsigned seed, struct wire *wire)
{
    if (size < HEADER)
        return 0;
    int is_pcapng = data[0] & 1, is_big_endian = data[0] >> 1 & 1;
    size_t at = HEADER, least = is_pcapng ? PCAPNG_BLOCK : PCAP_RECORD, head = is_pcapng ? PCAPNG_HEAD
        : PCAP_RECORD, found = 0;
    while (size - at >= least) {
        uint8_t *record = data + at;
        size_t left = size - at - least,
            len = record[is_big_endian ? (is_pcapng ? 23 : 11) : (is_pcapng ? 20 : 8)];
        if (len > left)
            len = left;
        size_t padded = is_pcapng ? (len + 3) / 4 * 4 : len;
        if (padded > left)
            padded = len = left / 4 * 4;
        put_number(record + (is_pcapng ? 20 : 8), is_big_endian, (uint32_t)len);
        if (is_pcapng) {
            put_number(record, is_big_endian, 6);
            put_number(record + 4, is_big_endian, (uint32_t)(PCAPNG_BLOCK + padded));
            put_number(record + 8, is_big_endian, record[11] & 1);
            put_number(record + PCAPNG_HEAD + padded, is_big_endian, (uint32_t)(PCAPNG_BLOCK + padded));
        }
        size_t frame = frame_in(record + head, len, data[0] >> 2 & 3);
        if (found++ == 0 || (seed >> 8) % found == 0) {
            wire->at = at + head + frame;
            wire->len = len - frame;
            wire->is_fixed = 1;
        }
        at += least + padded;
    }
    return found > 0;
}
