/* A drive's proofs, and which of them serve: a device may be silent to registers that it lacks, and a
 * document wrong about what a register holds. */
#include "line.h"

/* A proof that was never answered is dropped after so many times in vain; a silence counts if other replies
 * came before it. */
enum { MOST_VAIN = 2, ANSWERED = 0xFF };

/* Return which of the drive's proofs it is; their number: none, as most are. Then the list is not looked at,
 * which is elsewhere in memory. */
static uint32_t place_of(const struct md_exchange *exchange)
{
    const struct md_drive *drive = exchange->drive;
    uint32_t at = exchange->is_proof ? 0 : drive->proof_count;
    while (at < drive->proof_count && drive->proofs[at] != exchange)
        at++;
    return at;
}

int md_proof_is(const struct md_exchange *exchange)
{
    return place_of(exchange) < exchange->drive->proof_count;
}

/* One alone proves nothing of its own late replies. */
static void drop(struct md_drive *drive, uint32_t at)
{
    drive->proof_count--;
    for (; at < drive->proof_count; at++) {
        drive->proofs[at] = drive->proofs[at + 1];
        drive->vain[at] = drive->vain[at + 1];
    }
    if (drive->proof_count == 1)
        drive->proof_count = 0;
}

void md_proof_end(const struct md_exchange *exchange, int result)
{
    struct md_drive *drive = exchange->drive;
    uint32_t at = place_of(exchange);
    if (at == drive->proof_count || drive->vain[at] == ANSWERED)
        return;
    uint64_t replies = md_replies(drive);
    int is_silent_to_it = result == MD_NO_REPLY && replies != drive->vain_at;
    if (result > 0)
        drive->vain[at] = ANSWERED;
    if (!is_silent_to_it && result != MD_BAD_ECHO) /* which is another value than its document says */
        return;
    drive->vain_at = replies;
    if (++drive->vain[at] == MOST_VAIN)
        drop(drive, at);
}

void md_proof_came_late(struct md_drive *drive, const struct md_owed *owed)
{
    for (uint32_t i = 0; i < MD_MOST_PROOFS && i < drive->proof_count; i++)
        if (md_owed_is_same(owed, drive->proofs[i]))
            drive->vain[i] = ANSWERED;
}
