// Runs the kernels of whole stages without JAX, as `check.cc` does those of transfers: with particles
// that are masked, outside, or not finite. Exits with 1 where results depend on the number of threads
// or are not finite.
#include <cstdio>
#include <random>

#include "exchange_pull.h"
#include "exchange_tangent.h"
#include "threads.h"

namespace {

constexpr int kBatch = 3;

// The arrays of a batch of particles, and room for what the kernels make of them.
template <class T, int D>
struct Arrays {
  Shape<D> shape;
  Index n;
  Numbers<T> xi, position, mass, volume, v, C, He, H, nodes, first, second, third;
  std::vector<char> alive, inside, held;
  Numbers<T> numbers = {T(0.01), T(0.5), T(0.25), T(0.8)};

  explicit Arrays(Index particles) : n(kBatch * particles) {
    shape.particles = particles;
    for (int i = 0; i < D; ++i) shape.nodes[i] = 20 + i;
    std::mt19937 random(1);
    std::normal_distribution<T> normal;
    std::uniform_real_distribution<T> anywhere(0, 14);
    const auto drawn = [&](Index count, T scale) {
      Numbers<T> a(count);
      for (T& x : a) x = scale * normal(random);
      return a;
    };
    xi.resize(n * D);
    for (T& x : xi) x = anywhere(random);
    position = xi, v = drawn(n * D, 1), C = drawn(n * D * D, 1), He = drawn(n * 9, T(0.3));
    H = drawn(n * 9, T(0.3)), nodes = drawn(kBatch * shape.node_count() * kChannels, 1);
    mass.assign(n, 2), volume.assign(n, 1), first.assign(n, T(0.3)), second.assign(n, T(1.5));
    third.assign(n, T(0.1));
    alive.assign(n, 1), inside.assign(n, 1), held.assign(n, 0);
    for (Index p = 0; p < n; p += 53) He[9 * p + 4] = NAN, alive[(p + 1) % n] = 0, held[(p + 2) % n] = 1;
    for (Index p = 5; p < n; p += 71) xi[D * p] = p % 2 ? T(1e30) : T(NAN), inside[p] = 0;
  }
  static Batched<const bool> mask(const std::vector<char>& a) {
    return {reinterpret_cast<const bool*>(a.data()), Index(a.size()) / kBatch};
  }
};

template <class T, int D, int K, bool Mls, template <class> class Law, class Map>
Numbers<T> run(const Arrays<T, D>& a, Pool pool) {
  Numbers<T> all;
  const auto keep = [&](const Numbers<T>& x) { all.insert(all.end(), x.begin(), x.end()); };
  const auto shared = [](const Numbers<T>& x) { return Batched<const T>{x.data(), 0}; };
  const auto each = [](const Numbers<T>& x) { return in(x, kBatch); };
  const auto made = [](Numbers<T>& x) { return out(x, kBatch); };

  const Sender<T> sender{each(a.xi),  each(a.position), each(a.v),      each(a.C),
                         each(a.He),  each(a.H),        a.mask(a.alive), a.mask(a.inside),
                         each(a.mass), each(a.volume),  shared(a.numbers), {each(a.second), each(a.third)},
                         {1, 1},      true};
  Numbers<T> g(a.nodes.size());
  std::vector<char> alive(a.n), finite(a.n);
  std::vector<Count> events(kBatch * kEvents);
  const auto bools = [](std::vector<char>& x) {
    return Batched<bool>{reinterpret_cast<bool*>(x.data()), Index(x.size()) / kBatch};
  };
  for (const bool whole : {true, false}) {
    send<T, D, K, Mls, Law<T>>(a.shape, kBatch, whole, sender,
                               {made(g), bools(alive), bools(finite), {events.data(), kEvents}}, pool);
    keep(g);
  }
  for (char x : alive) all.push_back(x);
  for (char x : finite) all.push_back(x);
  for (Count x : events) all.push_back(T(x));

  // Along what is there itself, the numbers that are not finite put away.
  const auto tame = [](Numbers<T> x) {
    for (T& e : x) e = std::isfinite(e) && std::fabs(e) < 1e6 ? e : T(1);
    return x;
  };
  const auto dxi = tame(a.xi), dHe = tame(a.He);
  const Sender<T> along{each(dxi),    each(dxi),       each(a.v),       each(a.C),
                        each(dHe),    each(a.H),       a.mask(a.alive), a.mask(a.inside),
                        each(a.mass), each(a.volume),  shared(a.numbers), {each(a.second), each(a.third)},
                        {1, 1},       true};
  Numbers<T> dg(g.size());
  send_tangent<T, D, K, Mls, Law<T>>(a.shape, kBatch, sender, along, made(dg), pool);
  keep(dg);

  Walls<D> walls;
  walls.contact = kSeparating;
  std::vector<std::int8_t> sides(40, 0);
  std::fill(sides.begin(), sides.begin() + 4, -1), std::fill(sides.begin() + 15, sides.end(), 1);
  for (auto& side : walls.side) side = {sides.data(), 0};
  Numbers<T> v(g.size()), friction = {T(0.4)}, numbers_bar(kBatch * 4), friction_bar(kBatch);
  velocities<T, D>(a.shape.nodes, kBatch, walls, each(g), shared(a.numbers), shared(friction), made(v), pool);
  keep(v);
  const std::int32_t bounds[2 * 3] = {1, 2, 3, 5, 6, 7};
  walls.box = {bounds, 0};
  velocities<T, D>(a.shape.nodes, kBatch, walls, each(g), shared(a.numbers), shared(friction), made(v), pool);
  keep(v);
  velocities_tangent<T, D>(a.shape.nodes, kBatch, walls, each(g), shared(a.numbers), shared(friction),
                           each(a.nodes), shared(a.numbers), shared(friction), made(v), pool);
  keep(v);
  Numbers<T> g_bar(g.size());
  velocities_pull<T, D>(a.shape.nodes, kBatch, walls, each(g), shared(a.numbers), shared(friction),
                        each(a.nodes), made(g_bar), made(numbers_bar), made(friction_bar), pool);
  keep(g_bar), keep(numbers_bar), keep(friction_bar);

  Numbers<T> xi(a.xi.size()), x(a.xi.size()), mass(a.n), volume(a.n), new_v(a.v.size()), C(a.C.size());
  Numbers<T> He(a.He.size()), H(a.H.size()), first(a.n), second(a.n), third(a.n);
  send_pull<T, D, K, Mls, Law>(a.shape, kBatch, sender, each(a.nodes),
                               {made(xi), made(x), made(mass), made(volume), made(new_v), made(C),
                                made(He), made(H), {made(first), made(second)}, made(numbers_bar), {1, 1}},
                               pool);
  for (const auto* made : {&xi, &x, &mass, &volume, &new_v, &C, &He, &H, &first, &second, &numbers_bar})
    keep(*made);

  const Receiver<T> receiver{each(a.xi),  each(a.nodes), each(a.position), each(a.v), each(a.C),
                             each(a.He),  each(a.H),     Arrays<T, D>::mask(alive),
                             Arrays<T, D>::mask(finite), a.mask(a.held),   shared(a.numbers),
                             {each(a.first), each(a.second), each(a.third)}, {1, 1, 1}};
  receive<T, D, K, Mls, Map>(a.shape, kBatch, receiver,
                             {made(x), made(new_v), made(C), made(He), made(H), made(first)}, pool);
  for (const auto* made : {&x, &new_v, &C, &He, &H, &first}) keep(*made);
  const Receiver<T> moved{each(dxi), each(g),   each(dxi), each(a.v), each(a.C), each(dHe), each(a.H),
                          Arrays<T, D>::mask(alive), Arrays<T, D>::mask(finite), a.mask(a.held),
                          shared(a.numbers), {each(a.first), each(a.second), each(a.third)}, {1, 1, 1}};
  receive_tangent<T, D, K, Mls, Map>(
      a.shape, kBatch, receiver, moved, true,
      {made(x), made(new_v), made(C), made(He), made(H), made(first)}, pool);
  for (const auto* made : {&x, &new_v, &C, &He, &H, &first}) keep(*made);
  const ReceivedBars<T> bars{each(a.v), each(a.v), each(C), each(He), each(H), each(a.mass)};
  Numbers<T> C_bar(C.size()), He_bar(He.size()), H_bar(H.size());
  receive_pull<T, D, K, Mls, Map>(
      a.shape, kBatch, receiver, true, bars,
      {made(xi), made(g_bar), made(x), made(new_v), made(C_bar), made(He_bar), made(H_bar),
       {made(first), made(second), made(third)}, made(numbers_bar), {1, 1, 1}},
      pool);
  for (const auto* made : {&xi, &g_bar, &x, &new_v, &C_bar, &He_bar, &H_bar, &first, &numbers_bar})
    keep(*made);
  return all;
}

template <class T, int D, int K, bool Mls, template <class> class Law, class Map>
bool check() {
  for (Index particles : {0, 1, 17, 1500}) {
    const Arrays<T, D> arrays(particles);
    const auto expected = run<T, D, K, Mls, Law, Map>(arrays, Pool());
    for (T x : expected)
      if (!std::isfinite(x)) return std::printf("not finite\n"), false;
    for (int threads : {2, 3, 8}) {
      Threads more(threads - 1);
      if (run<T, D, K, Mls, Law, Map>(arrays, more.pool()) != expected)
        return std::printf("%d threads differ\n", threads), false;
    }
  }
  return true;
}

template <class T, int D>
bool check_dimension() {
  return check<T, D, 3, true, NeoHookean, Elastic<T>>() &&
         check<T, D, 4, false, FixedCorotated, VonMises<T>>() &&
         check<T, D, 3, false, StVKHencky, DruckerPrager<T>>();
}

}  // namespace

int main() {
  const bool good = check_dimension<float, 2>() && check_dimension<float, 3>() &&
                    check_dimension<double, 2>() && check_dimension<double, 3>();
  std::puts(good ? "equal" : "FAILED");
  return good ? 0 : 1;
}
