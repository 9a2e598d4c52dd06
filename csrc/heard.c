/* The bytes of one line that were overheard or read from a capture, in the pieces in which they came. */
#include "multidrop.h"

#include <string.h>


int md_hear(struct md_heard *heard, const uint8_t *bytes, size_t len, struct md_piece piece)
{
    if (heard->room - heard->len < len || heard->most == heard->count)
        return 0;
    piece.at = heard->len;
    memcpy(heard->bytes + heard->len, bytes, len);
    heard->len += len;
    heard->pieces[heard->count++] = piece;
    return 1;
}

void md_forget(struct md_heard *heard, struct md_splitter *splitter)
{
    size_t gone = splitter->at, first = splitter->piece;
    while (first + 1 < heard->count && heard->pieces[first + 1].at <= gone)
        first++;
    if (gone == heard->len)
        first = heard->count;
    memmove(heard->bytes, heard->bytes + gone, heard->len - gone);
    heard->len -= gone;
    heard->count -= first;
    memmove(heard->pieces, heard->pieces + first, heard->count * sizeof *heard->pieces);
    for (size_t i = 0; i < heard->count; i++) {
        struct md_piece *piece = &heard->pieces[i];
        /* What is left of a piece did not come after its pause. */
        if (piece->at < gone)
            piece->is_after_pause = 0;
        piece->at = piece->at < gone ? 0 : piece->at - gone;
    }
    splitter->at = splitter->piece = 0;
}
