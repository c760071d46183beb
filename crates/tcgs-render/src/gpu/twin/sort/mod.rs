//! A stable sort of pairs, in one go and by the steps of the kernels.

mod radix_histogram;
mod radix_scan;
mod radix_scatter;
mod sort_count;
mod sort_offsets;
mod sort_scatter;
mod stable_sort;

pub use radix_histogram::radix_histogram;
pub use radix_scan::radix_scan;
pub use radix_scatter::radix_scatter;
pub use sort_count::sort_count;
pub use sort_offsets::sort_offsets;
pub use sort_scatter::sort_scatter;
pub use stable_sort::radix_sort;
