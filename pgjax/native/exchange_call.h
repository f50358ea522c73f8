// The operands of `exchange.cc` and `exchange_pull.cc`.
#pragma once

#include "batched.h"
#include "exchange.h"

namespace {

using Mask = ffi::Buffer<ffi::PRED>;
using MaskOut = ffi::Result<Mask>;

// The step of a parameter from one particle to the next.
Index each_particle(In& parameter) {
  return parameter.dimensions()[is_batched(parameter, 1)] > 1 ? 1 : 0;
}

using Sides = ffi::Buffer<ffi::S8>;
using Bounds = ffi::Buffer<ffi::S32>;

// One array of sides for each direction, empty without walls; the box, empty for the whole grid.
Walls<D> walls_of(std::int64_t contact, Sides& x, Sides& y, Sides& z, Bounds& box) {
  Walls<D> walls;
  walls.contact = Contact(contact);
  Sides* const all[3] = {&x, &y, &z};
  for (int i = 0; i < D; ++i) walls.side[i] = shared_or_each(*all[i], 1);
  if (box.element_count() > 0) walls.box = shared_or_each(box, 1);
  return walls;
}

Sender<T> sender(Mask& alive, Mask& inside, In& xi, In& position, In& mass, In& volume, In& v, In& C,
                 In& He, In& H, In& mu, In& lam, In& numbers) {
  return {shared_or_each(xi, 2),      shared_or_each(position, 2),
          shared_or_each(v, 2),       shared_or_each(C, 3),
          shared_or_each(He, 3),      shared_or_each(H, 3),
          shared_or_each(alive, 1),   shared_or_each(inside, 1),
          shared_or_each(mass, 1),    shared_or_each(volume, 1),
          shared_or_each(numbers, 1), {shared_or_each(mu, 1), shared_or_each(lam, 1)},
          {each_particle(mu), each_particle(lam)},
          H.element_count() > 0};
}

Receiver<T> receiver(Mask& alive, Mask& finite, Mask& held, In& xi, In& g, In& position, In& v, In& C,
                     In& He, In& H, In& first, In& second, In& third, In& numbers) {
  return {shared_or_each(xi, 2),
          shared_or_each(g, D + 1),
          shared_or_each(position, 2),
          shared_or_each(v, 2),
          shared_or_each(C, 3),
          shared_or_each(He, 3),
          shared_or_each(H, 3),
          shared_or_each(alive, 1),
          shared_or_each(finite, 1),
          shared_or_each(held, 1),
          shared_or_each(numbers, 1),
          {shared_or_each(first, 1), shared_or_each(second, 1), shared_or_each(third, 1)},
          {each_particle(first), each_particle(second), each_particle(third)}};
}

}  // namespace

#define PGJAX_CALL()                                                                     \
  ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Attr<std::int64_t>("degree").Attr<bool>("mls") \
      .Attr<std::int64_t>("kind")
#define PGJAX_WALLS()                                                                          \
  ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Attr<std::int64_t>("contact").Arg<Sides>().Arg<Sides>() \
      .Arg<Sides>().Arg<Bounds>()
#define PGJAX_RET Ret<ffi::Buffer<kType>>()
// The floating operands of `sender` or `receiver`.
#define PGJAX_FLOATS \
  Arg<In>().Arg<In>().Arg<In>().Arg<In>().Arg<In>().Arg<In>().Arg<In>().Arg<In>().Arg<In>() \
      .Arg<In>().Arg<In>()
