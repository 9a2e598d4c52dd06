/* Captures: bytes of a line, put into packets and taken out again. Python calls these functions. */
#ifndef MULTIDROP_CAPTURE_H
#define MULTIDROP_CAPTURE_H

#include "multidrop.h"

/* cdef: start */
/* ---- tap.c: return a length in bytes ---- */

/* The sender, where it is known. The last two are no frames by the master's own account. */
enum md_side {
    MD_EITHER_SIDE,
    MD_ASKING,
    MD_ANSWERING,
    MD_FAILED, /* came in place of a reply */
    MD_NOISE,  /* stray bytes, echo, late replies */
    MD_SIDES
};

/* A ring with one writer and one reader. Zeroed but for `ring` and `room` it is empty. */
struct md_tap {
    uint8_t *ring;
    uint32_t room;       /* bytes, a power of two */
    uint32_t put, taken; /* each has one writer, only grows, and wraps around */
    uint64_t lost;       /* bytes without room */
    int64_t ahead_ns;    /* UTC - CLOCK_MONOTONIC of what is put next; 0: as when it is taken */
};

/* Header and trailer of a packet. Each side has two: for any bytes, and for those that begin with ':'. */
struct md_wrapping {
    const uint8_t *head, *tail;
    uint32_t head_len, tail_len; /* the tail's is a multiple of 4 */
};

/* Write whole pcapng packets to `out` while there is room. */
size_t md_tap_take(struct md_tap *tap, const struct md_wrapping *wrappings, uint32_t interface,
                   int64_t utc_minus_monotonic_ns, uint8_t *out, size_t room);
/* Return the length of the packet with `len` bytes that begin with `first`. */
size_t md_packet_length(const struct md_wrapping *wrappings, int side, uint8_t first, size_t len);
void md_put_packet(const struct md_wrapping *wrappings, uint32_t interface, int side, int64_t time_ns,
                   const uint8_t *bytes, size_t len, uint8_t *out);

/* ---- capture.c: return 1; 0 when room (md_stream_put) or more bytes (md_split) are needed ---- */

/* Bytes that came together, from `at` up to the next piece. */
struct md_piece {
    size_t at;
    int64_t time_ns;
    uint8_t side;           /* enum md_side */
    uint8_t is_after_pause; /* the line was silent before them: a hint */
};

/* Sniffed bytes that are not yet forgotten. */
struct md_stream {
    uint8_t *bytes;
    struct md_piece *pieces;
    size_t len, room, count, most; /* of the bytes, of the pieces */
    int is_all;                    /* nothing more will come */
    int is_tcp;                    /* all frames are MD_TCP's; else none is */
};

enum md_kind {
    MD_JUNK,    /* no frame */
    MD_REQUEST,
    MD_EITHER,  /* a request, or its copy that confirms it: what came before was not understood */
    MD_REPLY,   /* to the request before it */
    MD_STRAY    /* a reply without its request */
};

/* Sniffed bytes that belong together. */
struct md_span {
    size_t at, len;
    int64_t time_ns; /* time and side of the piece in which it begins */
    int side;
    int kind, framing;
    struct md_message message;
};

/* Zeroed, it is at the beginning. */
struct md_splitter {
    size_t at, piece;          /* what comes next */
    size_t junk;               /* bytes since the last frame */
    int is_in_step;            /* a frame came last: requests and their copies alternate */
    int awaited, framing;      /* of the reply to `request` */
    struct md_message request; /* the last one */
};

/* Append a piece. */
int md_stream_put(struct md_stream *stream, const uint8_t *bytes, size_t len, struct md_piece piece);
/* Forget what was split. */
void md_stream_forget(struct md_stream *stream, struct md_splitter *splitter);
/* Find the next span. Every byte is part of one. Only pauses and sides matter of how the bytes came in; junk
 * comes in any number of spans. */
int md_split(struct md_splitter *splitter, const struct md_stream *stream, struct md_span *span);

/* ---- capture.c: return an enum md_decoded ---- */

/* The fields of a request's reply; key 0: an empty place. */
struct md_known {
    uint64_t key;
    const struct md_block *block;
};

/* Zeroed but for `known` and `places`, a power of two, it is at the beginning. */
struct md_decoder {
    struct md_splitter splitter;
    struct md_span span;
    struct md_known *known;
    size_t places, taken;
    const struct md_block *block; /* of the last request */
    int64_t asked_ns;
    int is_sure, failure;         /* it was a request; why it has no reply, if none comes */
    int is_due;                   /* `span` is still to be dealt with */
    uint64_t frames, exchanges, junk, strays;
    struct md_completion completion;
};

enum md_decoded {
    MD_ALL_DECODED, /* but for what needs more bytes */
    MD_NO_ROOM,     /* in the columns */
    MD_UNKNOWN      /* the request in `span`: call md_know(), and again */
};

/* Say what replies to this request hold; NULL: nothing that makes rows. Return 0 when the table is full. */
int md_know(struct md_decoder *decoder, int framing, const struct md_message *request,
            const struct md_block *block);
/* Add the rows of every sniffed exchange, also of requests without a reply. */
int md_decode(struct md_decoder *decoder, const struct md_stream *stream, struct md_columns *columns);

/* ---- capture.c: return an enum md_unpacked ---- */

enum { MD_LINK_RTAC = 250, MD_LINK_EXPORTED = 252 }; /* link types with a header; all others: bare bytes */

/* One interface of a capture: a line. */
struct md_channel {
    uint32_t link;
    int has_sides;        /* the packets' directions are right */
    uint64_t ticks_per_s; /* of the packets' time stamps */
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
    MD_UNPACKED,      /* all of it */
    MD_CHANNEL_FULL,  /* split what the channels hold, and again */
    MD_OTHER_BLOCK,   /* of a pcapng file, at `at`: for the caller to read */
    MD_CUT,           /* the file ends within a packet */
    MD_NONSENSE       /* no packet begins at `at` */
};

/* Append packets to their channels' streams. */
int md_unpack(struct md_capture *capture);
/* cdef: end */

#endif
