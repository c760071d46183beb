//! How many connections each client's network has open, so that no one client takes every place.

use std::{
    collections::HashMap,
    net::IpAddr,
    sync::{Arc, Mutex, PoisonError},
};

use super::client::{ClientAddress, TrustedProxies};

/// Counts open connections by network ([`ClientAddress::network`]); clones share it. It holds an entry for each network that has one
/// open, and no other.
#[derive(Debug, Clone)]
pub(super) struct Peers {
    most: usize,
    /// Their connections are those of all their clients.
    unbounded: TrustedProxies,
    open: Arc<Mutex<HashMap<IpAddr, usize>>>,
}

impl Peers {
    /// Lets each network have `most` connections, and these proxies any number.
    pub(super) fn new(most: usize, unbounded: TrustedProxies) -> Self {
        Self { most, unbounded, open: Arc::default() }
    }

    /// A place for one more connection from `address`, unless its network has its fill.
    pub(super) fn admit(&self, address: ClientAddress) -> Option<Peer> {
        if self.unbounded.contains(address.0) {
            return Some(Peer { peers: self.clone(), network: None });
        }
        let network = address.network();
        let mut open = self.open.lock().unwrap_or_else(PoisonError::into_inner);
        let count = open.entry(network).or_insert(0);
        if *count >= self.most {
            if *count == 0 {
                open.remove(&network);
            }
            return None;
        }
        *count += 1;
        Some(Peer { peers: self.clone(), network: Some(network) })
    }
}

/// A connection's place; dropping it gives it back.
#[derive(Debug)]
pub(super) struct Peer {
    peers: Peers,
    /// The network that it is counted for.
    network: Option<IpAddr>,
}

impl Drop for Peer {
    fn drop(&mut self) {
        let Some(network) = self.network else { return };
        let mut open = self.peers.open.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(count) = open.get_mut(&network) {
            *count -= 1;
            if *count == 0 {
                open.remove(&network);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(text: &str) -> ClientAddress {
        ClientAddress(text.parse().expect("an address"))
    }

    #[test]
    fn all_addresses_of_an_ipv6_host_are_one_client() {
        let peers = Peers::new(2, TrustedProxies::default());
        let _held = ["2001:db8:1:2::1", "2001:db8:1:2:ffff::2"]
            .map(|text| peers.admit(address(text)).expect("a place"));
        assert!(
            peers.admit(address("2001:db8:1:2::3")).is_none(),
            "a host chooses among the addresses of its /64"
        );
        assert!(peers.admit(address("2001:db8:1:3::1")).is_some());
    }

    #[test]
    fn each_address_has_its_own_places_and_leaves_nothing_behind() {
        let peers = Peers::new(2, TrustedProxies::default());
        let [one, mapped, other] = ["10.0.0.1", "::ffff:10.0.0.1", "10.0.0.2"].map(address);
        let held = [peers.admit(one).expect("a place"), peers.admit(mapped).expect("a place")];
        assert!(peers.admit(one).is_none(), "the address has its fill, however it is written");
        let elsewhere = peers.admit(other).expect("another has places of its own");
        drop(held);
        assert!(peers.admit(one).is_some());
        drop(elsewhere);
        assert!(peers.open.lock().expect("not poisoned").is_empty());
        let closed = Peers::new(0, TrustedProxies::default());
        assert!(closed.admit(one).is_none() && closed.open.lock().expect("not poisoned").is_empty());
    }
}
