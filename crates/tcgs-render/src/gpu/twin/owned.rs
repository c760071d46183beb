//! The run of elements that an invocation owns.

/// The part of `count` elements that invocation `run` of `runs` owns.
pub(super) fn owned(count: usize, runs: usize, run: usize) -> std::ops::Range<usize> {
    let length = count.div_ceil(runs);
    let begin = (run * length).min(count);
    begin..(begin + length).min(count)
}
