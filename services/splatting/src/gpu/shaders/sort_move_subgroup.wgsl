// With subgroups of any size: the keys of a subgroup that share a digit find each other by nine ballots, and the subgroups
// of a chunk take their turns.
//
// A key's position in the chunk follows from its subgroup and its lane, not from its local index: nothing says that
// subgroups are cut from a workgroup in the order of local indices.

/// Bits of the lanes below this one.
fn below_lane(lane: u32) -> vec4u {
    var bits = vec4u();
    for (var word = 0u; word < 4u; word++) {
        if lane >= 32u * (word + 1u) {
            bits[word] = 0xffffffffu;
        } else if lane > 32u * word {
            bits[word] = (1u << (lane - 32u * word)) - 1u;
        }
    }
    return bits;
}

fn count_bits(bits: vec4u) -> u32 {
    let counts = countOneBits(bits);
    return counts.x + counts.y + counts.z + counts.w;
}

fn lowest_bit(bits: vec4u) -> u32 {
    for (var word = 0u; word < 4u; word++) {
        if bits[word] != 0u {
            return 32u * word + firstTrailingBit(bits[word]);
        }
    }
    return 0u;
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) local: u32,
    @builtin(subgroup_id) subgroup: u32,
    @builtin(num_subgroups) subgroups: u32,
    @builtin(subgroup_size) size: u32,
    @builtin(subgroup_invocation_id) lane: u32,
) {
    let view = group.z;
    let share = share_of(view);
    if group.x >= share.groups {
        return;
    }
    let end = min((group.x + 1u) * share.part, share.items);
    begin(view, share.groups, group.x, local);
    let position = subgroup * size + lane;
    for (var first = group.x * share.part; first < end; first += 256u) {
        let item = item_at(view, first + position, end);
        var same = subgroupBallot(true);
        for (var bit = 0u; bit < 9u; bit++) {
            let is_set = (item.digit >> bit & 1u) == 1u;
            let votes = subgroupBallot(is_set);
            same &= select(~votes, votes, vec4<bool>(is_set));
        }
        let rank = count_bits(same & below_lane(lane));
        var start = 0u;
        for (var turn = 0u; turn < subgroups; turn++) {
            if turn == subgroup && rank == 0u && item.digit != NO_DIGIT {
                start = atomicAdd(&next[item.digit], count_bits(same));
            }
            workgroupBarrier();
        }
        start = subgroupShuffle(start, lowest_bit(same));
        put(view, item, start + rank);
    }
    finish(view, group.x, local);
}
