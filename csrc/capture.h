/* Captures: write the bytes of a line as packets of a capture file, and read them back. Python calls these
 * functions. */
#ifndef MULTIDROP_CAPTURE_H
#define MULTIDROP_CAPTURE_H

#include "rows.h"

/* cdef: start */
/* ---- tap.c: functions return a length in bytes ---- */

/* The sender of captured bytes. MD_FAILED and MD_NOISE mark bytes that are not a frame; only a capture by
 * multidrop has these two marks. */
enum md_side {
    MD_EITHER_SIDE, /* unknown sender */
    MD_ASKING,      /* the master: a request */
    MD_ANSWERING,   /* a drive: a reply */
    MD_FAILED,      /* bytes that came instead of a good reply */
    MD_NOISE,       /* stray bytes, echoes, late replies */
    MD_SIDES
};

/* A ring buffer with one writer and one reader. It is empty if all fields except `ring` and `room` are 0. */
struct md_tap {
    uint8_t *ring;
    uint32_t room;       /* size of `ring` in bytes, a power of two */
    uint32_t put, taken; /* bytes written and read so far, modulo 2^32; each is changed by one thread */
    uint64_t lost;       /* bytes dropped because the ring was full */
    int64_t ahead_ns;    /* UTC - CLOCK_MONOTONIC for the next bytes; 0: use md_tap_take()'s argument */
};

/* Header and trailer of a packet. Each side has two such pairs: one for bytes that start with ':', one for
 * all others. */
struct md_wrapping {
    const uint8_t *head, *tail;
    uint32_t head_len, tail_len; /* tail_len is a multiple of 4 */
};

/* Move bytes from the ring to `out` as whole pcapng packets, as many as fit; return their length. */
size_t md_tap_take(struct md_tap *tap, const struct md_wrapping *wrappings, uint32_t interface,
                   int64_t utc_minus_monotonic_ns, uint8_t *out, size_t room);
/* Return how many bytes of the file a packet with `len` bytes takes. Its wrapping depends on its `first`
 * byte. */
size_t md_packet_length(const struct md_wrapping *wrappings, int side, uint8_t first, size_t len);
void md_put_packet(const struct md_wrapping *wrappings, uint32_t interface, int side, int64_t time_ns,
                   const uint8_t *bytes, size_t len, uint8_t *out);

/* ---- capture.c: return 1 on success; 0 if the buffer is full, or if a span needs more bytes ---- */

/* Bytes that were received together, from index `at` to the start of the next piece. */
struct md_piece {
    size_t at;
    int64_t time_ns;
    uint8_t side;           /* enum md_side */
    uint8_t is_after_pause; /* probably the line was silent before these bytes */
};

/* A buffer of sniffed bytes. */
struct md_stream {
    uint8_t *bytes;
    struct md_piece *pieces;
    size_t len, room, count, most; /* number and limit of bytes; number and limit of pieces */
    int is_all;                    /* 1: no more bytes will come */
    int is_tcp;                    /* 1: all frames are Modbus TCP; 0: no frame is */
};

enum md_kind {
    MD_JUNK,    /* not a frame */
    MD_REQUEST,
    MD_EITHER,  /* a request, or the reply that repeats it; unknown which, because junk came before */
    MD_REPLY,   /* the reply to the previous request */
    MD_STRAY    /* a reply without its request */
};

/* A frame, or junk between frames. */
struct md_span {
    size_t at, len;
    int64_t time_ns; /* `time_ns` and `side` are those of the frame's first piece */
    int side;
    int kind, framing;
    struct md_message message;
};

/* The splitter's position in a stream; all zero: the start. */
struct md_splitter {
    size_t at, piece;          /* index of the next byte, and of its piece */
    size_t junk;               /* number of bytes since the last frame */
    /* 1: a frame ended at `at`; 0: junk came, so an apparent request may be a reply */
    int is_in_step;
    int awaited, framing;      /* `awaited`: the reply to `request` is due, in this framing */
    struct md_message request; /* the last request */
};

/* Append these bytes as a piece; return 0 if there is no room. */
int md_stream_put(struct md_stream *stream, const uint8_t *bytes, size_t len, struct md_piece piece);
/* Discard the bytes before the splitter's position. */
void md_stream_forget(struct md_stream *stream, struct md_splitter *splitter);
/* Find the next span. Every byte becomes part of a span; junk may be split into several spans. Cuts between
 * pieces matter only if there is a pause, or if the side changes. */
int md_split(struct md_splitter *splitter, const struct md_stream *stream, struct md_span *span);

/* ---- capture.c: return an enum md_decoded ---- */

/* The fields in the reply to requests with this key; key 0: an empty slot. */
struct md_known {
    uint64_t key;
    const struct md_block *block;
};

/* The state of decoding. At the start all is zero except `known` and its length `places`, a power of two. */
struct md_decoder {
    struct md_splitter splitter;
    struct md_span span;
    struct md_known *known;
    size_t places, taken;
    const struct md_block *block; /* fields in the reply to the last request */
    int64_t asked_ns;
    /* is_sure: 1: the last frame was surely a request; failure: the result without a reply */
    int is_sure, failure;
    int is_due;                   /* 1: `span` is not processed yet */
    uint64_t frames, exchanges, junk, strays;
    struct md_completion completion;
};

enum md_decoded {
    MD_ALL_DECODED, /* all but an incomplete frame at the end is decoded */
    MD_NO_ROOM,     /* the columns are full */
    MD_UNKNOWN      /* unknown request in `span`: call md_know() and repeat */
};

/* Store which fields the replies to this request contain (`block` NULL: none, so no rows). Return 0 if the
 * table of requests is full. */
int md_know(struct md_decoder *decoder, int framing, const struct md_message *request,
            const struct md_block *block);
/* Add rows to `columns` for all sniffed exchanges, including requests without a reply. */
int md_decode(struct md_decoder *decoder, const struct md_stream *stream, struct md_columns *columns);

/* ---- capture.c: return an enum md_unpacked ---- */

enum { MD_LINK_RTAC = 250, MD_LINK_EXPORTED = 252 }; /* link types with a header; others: bare frames */

/* An interface of a capture: one line. */
struct md_channel {
    uint32_t link;
    int has_sides;        /* the packets state their direction reliably */
    uint64_t ticks_per_s; /* unit of the packets' time stamps */
    int64_t offset_ns;
    struct md_stream stream;
};

struct md_capture {
    const uint8_t *bytes;
    size_t len, at;
    int is_pcapng, is_big_endian;
    struct md_channel *channels;
    size_t count;
};

enum md_unpacked {
    MD_UNPACKED,      /* the whole file */
    MD_CHANNEL_FULL,  /* a stream is full: call md_split() for the channels, then repeat */
    MD_OTHER_BLOCK,   /* another pcapng block at `at`, which the caller must read */
    MD_CUT,           /* the file ends within a packet */
    MD_NONSENSE       /* invalid packet at `at` */
};

/* Append packets to their channels' streams until the caller must act: see enum md_unpacked. */
int md_unpack(struct md_capture *capture);
/* cdef: end */

#endif
