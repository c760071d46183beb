//! Prefix sums, in one go and by the steps of the kernels.

mod prefix_sums;
mod scan_apply;
mod scan_block_sums;
mod scan_blocks;
mod scan_partials;
mod scan_reduce;

pub use prefix_sums::scan;
pub use scan_apply::scan_apply;
pub use scan_block_sums::scan_block_sums;
pub use scan_blocks::scan_blocks;
pub use scan_partials::scan_partials;
pub use scan_reduce::scan_reduce;
