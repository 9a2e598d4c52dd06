/* The bytes of one line that were sniffed or read from a capture, in the pieces in which they came. */
#include "internal.h"

#include <string.h>


int md_hear(struct md_stream *stream, const uint8_t *bytes, size_t len, struct md_piece piece)
{
    if (stream->room - stream->len < len || stream->most == stream->count)
        return 0;
    piece.at = stream->len;
    memcpy(stream->bytes + stream->len, bytes, len);
    stream->len += len;
    stream->pieces[stream->count++] = piece;
    return 1;
}

void md_forget(struct md_stream *stream, struct md_splitter *splitter)
{
    size_t gone = splitter->at, first = splitter->piece;
    while (first + 1 < stream->count && stream->pieces[first + 1].at <= gone)
        first++;
    if (gone == stream->len)
        first = stream->count;
    memmove(stream->bytes, stream->bytes + gone, stream->len - gone);
    stream->len -= gone;
    stream->count -= first;
    memmove(stream->pieces, stream->pieces + first, stream->count * sizeof *stream->pieces);
    for (size_t i = 0; i < stream->count; i++) {
        struct md_piece *piece = &stream->pieces[i];
        /* What is left of a piece did not come after its pause. */
        if (piece->at < gone)
            piece->is_after_pause = 0;
        piece->at = piece->at < gone ? 0 : piece->at - gone;
    }
    splitter->at = splitter->piece = 0;
}
