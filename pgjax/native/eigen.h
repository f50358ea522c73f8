// Eigenvalues and eigenvectors of symmetric 3 x 3 matrices, several at a time.
//
// Cyclic Jacobi, the same rotations as `pgjax.linalg.eigenbasis`, without branches: each number
// is a vector of the same entry of a whole group of matrices.
#pragma once

#include <cstdint>
#include <type_traits>

#include "blocks.h"

namespace pgjax {

// Rotates the basis in the plane (i, j) so that the entry `off` of the matrix vanishes.
template <class V>
inline void rotate(V& ii, V& jj, V& off, V& ki, V& kj, V qi[3], V qj[3]) {
  const V zero = {}, one = zero + 1;
  const V gap = jj - ii, size = gap < 0 ? -gap : gap;
  const V below = size + root(gap * gap + 4 * off * off);
  const V tangent = 2 * off / (below > 0 ? below : one);
  const V t = gap < 0 ? -tangent : tangent;
  const V c = 1 / root(1 + t * t), s = t * c;
  // c u - s v as u - s (v + s/(1 + c) u): only the change is rounded (Rutishauser 1966).
  const V half = s / (1 + c);
  ii -= t * off, jj += t * off, off = zero;
  const V u = ki, v = kj;
  ki = u - s * (v + half * u), kj = v + s * (u - half * v);
  for (int m = 0; m < 3; ++m) {
    const V x = qi[m], y = qj[m];
    qi[m] = x - s * (y + half * x), qj[m] = y + s * (x - half * y);
  }
}

template <class V>
inline void put_larger_first(V& wi, V& wj, V qi[3], V qj[3]) {
  const auto swap = wi < wj;
  const V a = wi, b = wj;
  wi = swap ? b : a, wj = swap ? a : b;
  for (int m = 0; m < 3; ++m) {
    const V x = qi[m], y = qj[m];
    qi[m] = swap ? y : x, qj[m] = swap ? x : y;
  }
}

template <class V>
constexpr int kSweeps = sizeof(V{}[0]) == sizeof(float) ? 4 : 6;

// One group: the six entries in `a` (00, 11, 22, 01, 02, 12), eigenvalues and basis out, the
// columns of which are the vectors.
template <class V>
inline void diagonalise(const V a[6], V w[3], V q[9]) {
  const V zero = {}, one = zero + 1;
  V scale = zero;
  for (int i = 0; i < 6; ++i) {
    const V size = a[i] < 0 ? -a[i] : a[i];
    scale = size > scale ? size : scale;
  }
  scale = scale > 0 ? scale : one;
  V a00 = a[0] / scale, a11 = a[1] / scale, a22 = a[2] / scale;
  V a01 = a[3] / scale, a02 = a[4] / scale, a12 = a[5] / scale;
  V q0[3] = {one, zero, zero}, q1[3] = {zero, one, zero}, q2[3] = {zero, zero, one};
  for (int sweep = 0; sweep < kSweeps<V>; ++sweep) {
    rotate(a00, a11, a01, a02, a12, q0, q1);
    rotate(a00, a22, a02, a01, a12, q0, q2);
    rotate(a11, a22, a12, a01, a02, q1, q2);
  }
  put_larger_first(a00, a11, q0, q1);
  put_larger_first(a00, a22, q0, q2);
  put_larger_first(a11, a22, q1, q2);
  w[0] = a00 * scale, w[1] = a11 * scale, w[2] = a22 * scale;
  for (int m = 0; m < 3; ++m) q[3 * m] = q0[m], q[3 * m + 1] = q1[m], q[3 * m + 2] = q2[m];
}

// `count` matrices (3, 3) in rows; eigenvalues (3), largest first, and vectors in columns (3, 3).
template <class T>
void eigenbasis(std::int64_t count, const T* A, T* w, T* Q, Pool& pool) {
  using V = Group<T>;
  const Column<const T> ins[] = {{A, 9}};
  const Column<T> outs[] = {{w, 3}, {Q, 9}};
  for_each_block<T, 9, 12>(count, ins, outs, pool, [](const V* a, V* made) {
    const V symmetric[6] = {a[0], a[4], a[8], a[1], a[2], a[5]};
    diagonalise(symmetric, made, made + 3);
  });
}

}  // namespace pgjax
