//! What requests share: counted places, reservations, caches, queues and rate limits.
//!
//! Each part has the services that it needs. None knows the handlers or their state, which holds one of each.

mod auth_mode;
mod cached;
mod checks;
mod export_queue;
mod held_bytes;
mod in_flight;
mod reservations;
mod slots;
mod stats;
mod throttle;
mod watcher;

pub(super) use self::{
    auth_mode::AuthMode,
    checks::{Checks, OK},
    export_queue::{ExportQueue, ExportTurn},
    held_bytes::{Held, HeldBytes},
    in_flight::{IdempotencyGuard, InFlight},
    reservations::{DiskReservation, Reservation, ReservationError, Reservations},
    slots::{Capacity, Slot, Slots},
    stats::StatsCache,
    throttle::{Throttle, Wait},
    watcher::Watcher,
};
