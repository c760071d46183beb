#define_import_path tcgs::runs

// Runs of columns that weight gradients are summed over first: at most so many, and none shorter than that but the last.
const RUNS: u32 = 128u;
const MIN_RUN: u32 = 128u;

// Columns of a run. It depends on their number alone, so that sums do not depend on the capacity of buffers.
fn run_length(columns: u32) -> u32 {
    let length = (columns + RUNS - 1u) / RUNS;
    return max(MIN_RUN, (length + 7u) / 8u * 8u);
}
