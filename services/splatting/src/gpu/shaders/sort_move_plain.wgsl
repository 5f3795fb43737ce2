// Without subgroups: every key counts the keys of its chunk that come before it and share its digit.

/// Digits of the chunk, four to a vector.
var<workgroup> digits: array<vec4u, 64>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let view = group.z;
    let share = share_of(view);
    if group.x >= share.groups {
        return;
    }
    let end = min((group.x + 1u) * share.part, share.items);
    begin(view, share.groups, group.x, local);
    for (var first = group.x * share.part; first < end; first += 256u) {
        let item = item_at(view, first + local, end);
        digits[local / 4u][local % 4u] = item.digit;
        workgroupBarrier();
        var earlier = vec4u();
        for (var i = 0u; i < local / 4u; i++) {
            earlier += select(vec4u(), vec4u(1u), digits[i] == vec4u(item.digit));
        }
        var rank = earlier.x + earlier.y + earlier.z + earlier.w;
        for (var i = local / 4u * 4u; i < local; i++) {
            rank += u32(digits[i / 4u][i % 4u] == item.digit);
        }
        var place = 0u;
        if item.digit != NO_DIGIT {
            place = atomicLoad(&next[item.digit]) + rank;
        }
        workgroupBarrier();
        put(view, item, place);
        // The last key of a digit has the largest place.
        if item.digit != NO_DIGIT {
            atomicMax(&next[item.digit], place + 1u);
        }
        workgroupBarrier();
    }
    finish(view, group.x, local);
}
