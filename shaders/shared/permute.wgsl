#define_import_path tcgs::permute

#import tcgs::index::group_index

// Which of the equal parts of the work a workgroup does.
//
// Work has an end that the host does not know: lists are shorter than their buffers, and tiles at an image's border are emptier
// than others. A software adapter gives each of its threads one run of consecutive workgroups, so parts in order would
// leave most threads without work. There each of four rounds deals the parts out alternately, so that each of up to 16 threads does
// parts from everywhere.

#ifdef SOFTWARE
fn shuffled(part: u32, parts: u32) -> u32 {
    let half = (parts + 1u) / 2u;
    return select(2u * (part - half) + 1u, 2u * part, part < half);
}
#endif

// A permutation of the workgroups' linear indices.
fn part_of(group: vec3u, groups: vec3u) -> u32 {
    var part = group_index(group);
#ifdef SOFTWARE
    let parts = groups.x * groups.y;
    part = shuffled(shuffled(shuffled(shuffled(part, parts), parts), parts), parts);
#endif
    return part;
}
