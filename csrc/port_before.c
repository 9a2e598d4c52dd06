/* The requests that go before an exchange where it needs them: proofs, by which no late reply is taken for
 * its own, and an echo probe. */
#include "turn.h"

enum { MOST_PROOFS_SENT = 12 }; /* before one exchange */

const struct md_exchange *md_before_find(struct md_before *before, const struct md_exchange *exchange,
                                         int is_echo_in_doubt, int64_t now_ns)
{
    const struct md_drive *drive = exchange->drive;
    if (before->then != exchange)
        *before = (struct md_before){.then = exchange, .failures = drive->failures};
    const struct md_exchange *proof = md_late_proof(exchange, now_ns);
    int has_helped = before->proofs == 0 || md_replies(drive) != before->replies;
    if (proof && has_helped && before->proofs < MOST_PROOFS_SENT) {
        before->proofs++;
        before->replies = md_replies(drive);
        return proof;
    }
    if (!exchange->echo_probe || !is_echo_in_doubt || before->is_probed)
        return NULL;
    before->is_probed = 1;
    return exchange->echo_probe;
}

/* A write is never sent again: it may have started a motor. */
int md_before_is_again(struct md_before *before, const struct md_exchange *exchange,
                       const struct md_completion *completion)
{
    int is_in_doubt = completion->result == MD_LATE_ANSWER_DUE && completion->sent_ns;
    if (is_in_doubt && md_is_read(exchange->framing, exchange->request.function) &&
        before->proofs < MOST_PROOFS_SENT)
        return 1;
    before->then = NULL;
    return 0;
}
