//! How many connections each address has open, so that no one address takes every place.

use std::{
    collections::HashMap,
    net::IpAddr,
    sync::{Arc, Mutex, PoisonError},
};

/// Counts open connections by address; clones share it. It holds an entry for each address that has one open, and no other.
#[derive(Debug, Clone)]
pub(super) struct Peers {
    most: usize,
    open: Arc<Mutex<HashMap<IpAddr, usize>>>,
}

impl Peers {
    /// Lets each address have `most` connections.
    pub(super) fn new(most: usize) -> Self {
        Self { most, open: Arc::default() }
    }

    /// A place for one more connection from `address`, unless it has its fill.
    pub(super) fn admit(&self, address: IpAddr) -> Option<Peer> {
        // An IPv4 client is the same one on a socket that takes both.
        let address = address.to_canonical();
        let mut open = self.open.lock().unwrap_or_else(PoisonError::into_inner);
        let count = open.entry(address).or_insert(0);
        if *count >= self.most {
            if *count == 0 {
                open.remove(&address);
            }
            return None;
        }
        *count += 1;
        Some(Peer { peers: self.clone(), address })
    }
}

/// A connection's place; dropping it gives it back.
#[derive(Debug)]
pub(super) struct Peer {
    peers: Peers,
    address: IpAddr,
}

impl Drop for Peer {
    fn drop(&mut self) {
        let mut open = self.peers.open.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(count) = open.get_mut(&self.address) {
            *count -= 1;
            if *count == 0 {
                open.remove(&self.address);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_address_has_its_own_places_and_leaves_nothing_behind() {
        let peers = Peers::new(2);
        let [one, mapped, other] = ["10.0.0.1", "::ffff:10.0.0.1", "10.0.0.2"]
            .map(|address| address.parse::<IpAddr>().expect("an address"));
        let held = [peers.admit(one).expect("a place"), peers.admit(mapped).expect("a place")];
        assert!(peers.admit(one).is_none(), "the address has its fill, however it is written");
        let elsewhere = peers.admit(other).expect("another has places of its own");
        drop(held);
        assert!(peers.admit(one).is_some());
        drop(elsewhere);
        assert!(peers.open.lock().expect("not poisoned").is_empty());
        let closed = Peers::new(0);
        assert!(closed.admit(one).is_none() && closed.open.lock().expect("not poisoned").is_empty());
    }
}
