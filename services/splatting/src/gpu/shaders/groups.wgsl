// How many workgroups share a view's sort and its binning: as many as there is work for. The number of drawn Gaussians is
// known to the GPU alone, so what comes after the first pass of the sort is dispatched indirectly, or, where an adapter
// cannot, with as many workgroups as all Gaussians could need, of which some find nothing to do. Needs `job` in the kernel.

/// Keys that a workgroup of the sort takes, and splats that one of the binning takes, until there are the most workgroups.
const SORT_PART: u32 = 1024u;
const BIN_PART: u32 = 2048u;

fn sort_groups_for(keys: u32) -> u32 {
    return clamp((keys + SORT_PART - 1u) / SORT_PART, 1u, job.sort_groups);
}

fn bin_groups_for(splats: u32) -> u32 {
    return clamp((splats + BIN_PART - 1u) / BIN_PART, 1u, job.bin_groups);
}
