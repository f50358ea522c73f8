// Runs the kernels without JAX: with 1, 2, 3 and 8 threads, with particles outside of the array
// and with NaN. Exits with 1 where results depend on the number of threads, or where a particle
// outside takes part. `tests/native/sanitize.sh` runs it under the sanitizers.
#include <cstdio>
#include <limits>
#include <random>

#include "eigen.h"
#include "laws.h"
#include "raster.h"
#include "threads.h"

namespace {

// Everything the kernels compute, one after the other.
template <class T, int D, int K, bool HasS>
Numbers<T> run(Index particles, Index batch, const Numbers<T>& xi, Pool& pool) {
  Shape<D> shape;
  shape.particles = particles;
  for (int i = 0; i < D; ++i) shape.nodes[i] = 29 + i;
  std::mt19937 random(7);
  std::normal_distribution<T> normal;
  const auto drawn = [&](Index n) {
    Numbers<T> a(n);
    for (T& v : a) v = normal(random);
    return a;
  };
  const Index n = batch * particles, nodes = shape.node_count() * kChannels;
  const Index values = n * kChannels, slopes = values * D, fluxes = HasS ? slopes : 0;
  const auto a = drawn(values), B = drawn(slopes), S = drawn(fluxes);
  const auto da = drawn(values), dB = drawn(slopes), dS = drawn(fluxes);
  const auto dxi = drawn(n * D), g = drawn(batch * nodes), dg = drawn(batch * nodes);
  const Payload<T> payload{in(a, batch), in(B, batch), in(S, batch)};
  const Payload<T> moved{in(da, batch), in(dB, batch), in(dS, batch)};
  Numbers<T> all;
  const auto keep = [&](const Numbers<T>& v) { all.insert(all.end(), v.begin(), v.end()); };

  Numbers<T> sums(batch * nodes), ra(a.size()), rB(B.size()), rS(S.size()), rx(xi.size());
  const Moments<T> moments{out(ra, batch), out(rB, batch), out(rS, batch)};
  scatter<T, D, K, HasS>(shape, batch, in(xi, batch), payload, out(sums, batch), pool);
  keep(sums);
  scatter_tangent<T, D, K, HasS>(shape, batch, in(xi, batch), payload, in(dxi, batch), moved,
                                 out(sums, batch), pool);
  keep(sums);
  gather<T, D, K, HasS>(shape, batch, in(xi, batch), in(g, batch), moments, pool);
  keep(ra), keep(rB), keep(rS);
  gather_tangent<T, D, K, HasS>(shape, batch, in(xi, batch), in(g, batch), in(dxi, batch),
                                in(dg, batch), moments, pool);
  keep(ra), keep(rB), keep(rS);
  pull<T, D, K, HasS>(shape, batch, in(xi, batch), payload, in(g, batch), out(rx, batch), moments,
                      pool);
  keep(rx), keep(ra), keep(rB), keep(rS);
  return all;
}

template <class T, int D, int K, bool HasS>
bool check(Index particles, Index batch) {
  std::mt19937 random(3);
  std::uniform_real_distribution<T> anywhere(0, 24);
  Numbers<T> xi(batch * particles * D);
  for (T& v : xi) v = anywhere(random);
  // Some leave the array a little, some by far, some are not numbers.
  const T bad[] = {T(-2.6), T(27.9), T(1e30), T(-1e30), T(NAN), T(INFINITY), T(-INFINITY)};
  for (std::size_t i = 0; i < xi.size(); i += 97) xi[i] = bad[(i / 97) % 7];

  Pool alone;
  const auto expected = run<T, D, K, HasS>(particles, batch, xi, alone);
  for (T v : expected)
    if (!std::isfinite(v)) return std::printf("not finite\n"), false;
  for (int threads : {2, 3, 8}) {
    Threads more(threads - 1);
    Pool pool = more.pool();
    const auto got = run<T, D, K, HasS>(particles, batch, xi, pool);
    if (got.size() != expected.size() ||
        std::memcmp(got.data(), expected.data(), got.size() * sizeof(T)))
      return std::printf("%d threads differ\n", threads), false;
  }
  return true;
}

template <class T, int D>
bool check_dimension() {
  return check<T, D, 3, true>(3000, 1) && check<T, D, 4, true>(3000, 1) &&
         check<T, D, 3, false>(700, 5) && check<T, D, 4, false>(1, 1) && check<T, D, 3, true>(0, 1);
}

// Q diag(w) Q^T and U diag(sigma) V^T are the matrix again, in groups that are full and in the rest of one.
template <class T>
bool check_eigen(std::int64_t count) {
  std::mt19937 random(5);
  std::normal_distribution<T> normal;
  Numbers<T> A(count * 9), w(count * 3), Q(count * 9), U(count * 9), sigma(count * 3), V(count * 9);
  for (std::int64_t p = 0; p < count; ++p)
    for (int i = 0; i < 3; ++i)
      for (int j = i; j < 3; ++j)
        A[9 * p + 3 * i + j] = A[9 * p + 3 * j + i] = p % 7 == 3 ? T(i == j) : normal(random);
  Threads more(2);
  Pool pool = more.pool();
  eigenbasis<T>(count, A.data(), w.data(), Q.data(), pool);
  svd<T>(count, A.data(), U.data(), sigma.data(), V.data(), pool);
  for (std::int64_t p = 0; p < count; ++p)
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        T sum = 0, product = 0;
        for (int k = 0; k < 3; ++k) {
          sum += Q[9 * p + 3 * i + k] * w[3 * p + k] * Q[9 * p + 3 * j + k];
          product += U[9 * p + 3 * i + k] * sigma[3 * p + k] * V[9 * p + 3 * j + k];
        }
        const T expected = A[9 * p + 3 * i + j], bound = 80 * std::numeric_limits<T>::epsilon();
        if (!(std::fabs(sum - expected) < bound && std::fabs(product - expected) < bound))
          return std::printf("decomposition of matrix %d is wrong\n", int(p)), false;
      }
  return true;
}

template <class T>
bool check_eigen() {
  for (std::int64_t count : {0, 1, 15, 16, 17, 5000})
    if (!check_eigen<T>(count)) return false;
  return true;
}

// A law or a return mapping of three numbers besides H: finite, and the same with more threads.
template <class T, class F>
bool check_law(const F& one) {
  for (std::int64_t count : {0, 1, 129, 5000}) {
    std::mt19937 random(9);
    std::normal_distribution<T> normal;
    Numbers<T> H(count * 9), more(count * 3, T(0.3)), out(count * 12), again(count * 12);
    for (T& v : H) v = normal(random) / 3;
    const auto run = [&](Numbers<T>& to, Pool pool) {
      const Column<const T> ins[] = {{H.data(), 9}, {more.data(), 3}};
      const Column<T> outs[] = {{to.data(), 12}};
      for_each_block<T, 12, 12>(count, ins, outs, pool, [&](const Group<T>* a, Group<T>* made) {
        for (int e = 0; e < 12; ++e) made[e] = Group<T>{};
        one(a, made);
      });
    };
    Threads others(2);
    run(out, Pool()), run(again, others.pool());
    if (out != again)
      return std::printf("a law depends on the number of threads\n"), false;
    for (T v : out)
      if (!std::isfinite(v)) return std::printf("a law is not finite\n"), false;
  }
  return true;
}

template <class T>
bool check_laws() {
  using V = Group<T>;
  return check_law<T>(neo_hookean<V>) && check_law<T>(fixed_corotated<V>) &&
         check_law<T>(stvk_hencky<V>) && check_law<T>(von_mises<V>) &&
         check_law<T>(drucker_prager<V>);
}

// Images, tangents and cotangents of splats of which some are no numbers, lie far outside, or cover
// everything: finite, and the same with more threads. Sizes that do not fill the last tiles.
template <class T>
Numbers<T> run_raster(Index count, Index channels, const raster::Frame& frame, bool smooth,
                      Pool& pool) {
  std::mt19937 random(11);
  std::normal_distribution<T> normal;
  std::uniform_real_distribution<T> unit(0, 1);
  const auto drawn = [&](Index n) {
    Numbers<T> a(n);
    for (T& v : a) v = normal(random);
    return a;
  };
  Numbers<T> shape(count * raster::kShape), key(count);
  for (Index i = 0; i < count; ++i) {
    T* s = &shape[i * raster::kShape];
    s[0] = frame.width * (2 * unit(random) - T(0.5)), s[1] = frame.height * (2 * unit(random) - T(0.5));
    s[2] = normal(random), s[3] = std::exp(2 * normal(random) - 4);
    s[4] = std::exp(2 * normal(random) - 4), s[5] = i % 5 ? unit(random) : T(1);
    const T bad[] = {T(NAN), T(INFINITY), T(-INFINITY), T(1e30), T(-1e30), T(0), T(1e-30)};
    if (i % 13 == 4) s[i / 13 % 6] = bad[i / 13 % 7];
    key[i] = i % 17 == 3 ? T(NAN) : std::floor(8 * normal(random));
  }
  const Index pixels = Index(frame.width) * frame.height, tangents = 3;
  const auto values = drawn(count * channels);
  const auto dshape = drawn(tangents * shape.size()), dvalues = drawn(tangents * values.size());
  const auto gsums = drawn(pixels * channels), gcover = drawn(pixels);
  const raster::Splats<T> splats{count, channels, shape.data(), values.data(), key.data()};
  const raster::Rule<T> rule{T(0.99), T(1) / 255, smooth ? T(0) : T(1e-4), smooth};
  const raster::Lists<T> lists(splats, frame, rule, pool);
  Numbers<T> all;
  const auto keep = [&](const Numbers<T>& v) { all.insert(all.end(), v.begin(), v.end()); };
  Numbers<T> sums(tangents * pixels * channels), cover(tangents * pixels);
  raster::composite(lists, rule, sums.data(), cover.data(), pool);
  keep(sums), keep(cover);
  raster::tangent(lists, rule, tangents, count, dshape.data(), dvalues.data(), sums.data(),
                  cover.data(), pool);
  keep(sums), keep(cover);
  Numbers<T> bar_shape(shape.size()), bar_values(values.size());
  raster::adjoint(lists, rule, gsums.data(), gcover.data(), bar_shape.data(), bar_values.data(),
                  pool);
  keep(bar_shape), keep(bar_values);
  return all;
}

template <class T>
bool check_raster(Index count, Index channels, const raster::Frame& frame, bool smooth) {
  Pool alone;
  const auto expected = run_raster<T>(count, channels, frame, smooth, alone);
  for (T v : expected)
    if (!std::isfinite(v)) return std::printf("an image is not finite\n"), false;
  for (int threads : {2, 3, 8}) {
    Threads more(threads - 1);
    Pool pool = more.pool();
    const auto got = run_raster<T>(count, channels, frame, smooth, pool);
    if (got.size() != expected.size() ||
        std::memcmp(got.data(), expected.data(), got.size() * sizeof(T)))
      return std::printf("%d threads make another image\n", threads), false;
  }
  return true;
}

template <class T>
bool check_raster() {
  return check_raster<T>(0, 4, {20, 9}, false) && check_raster<T>(1, 4, {1, 1}, true) &&
         check_raster<T>(5000, 4, {65, 31}, false) && check_raster<T>(600, 7, {33, 17}, true) &&
         check_raster<T>(600, 0, {8, 16}, false);
}

}  // namespace

int main() {
  const bool good = check_eigen<float>() && check_eigen<double>() && check_laws<float>() &&
                    check_laws<double>() && check_raster<float>() && check_raster<double>() &&
                    check_dimension<float, 2>() &&
                    check_dimension<float, 3>() &&
                    check_dimension<double, 2>() && check_dimension<double, 3>();
  std::puts(good ? "equal" : "FAILED");
  return good ? 0 : 1;
}
