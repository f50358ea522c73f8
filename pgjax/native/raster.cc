// What XLA calls: one library per precision (PGJAX_DOUBLE).
//
// Every array has a leading batch direction of length 1 or that of the call, `b`: limits (b, 4)
// alpha_max, alpha_min, stop, and 1 for the smooth cutoff; shape (b, n, 6); values (b, n, k); key
// (b, n); images (b, h, w, k) and (b, h, w).
#include "raster.h"

#include <exception>
#include <memory>

#include "xla.h"

using namespace pgjax::raster;
using Count = ffi::Result<ffi::Buffer<ffi::S32>>;

namespace {

template <class Buffer>
Index batch_step(Buffer& buffer) {
  const auto dimensions = buffer.dimensions();
  return dimensions[0] == 1 ? 0 : Index(buffer.element_count()) / dimensions[0];
}
const T* member(In& in, Index b) { return in.typed_data() + b * batch_step(in); }
T* member(Out& out, Index b) { return out->typed_data() + b * batch_step(*out); }

// The operands that say what is drawn.
struct Scene {
  In &limits, &shape, &values, &key;

  bool is_shared() const {
    for (In* in : {&limits, &shape, &values, &key})
      if (in->dimensions()[0] != 1) return false;
    return true;
  }
  Index count() const { return shape.dimensions()[1]; }
  Rule<T> rule(Index b) const {
    const T* l = member(limits, b);
    return {l[0], l[1], l[2], l[3] != 0};
  }
  Lists<T> lists(Index b, const Frame& frame, pgjax::Pool& pool) const {
    const Splats<T> splats{count(), values.dimensions()[2], member(shape, b), member(values, b),
                           member(key, b)};
    return Lists<T>(splats, frame, rule(b), pool);
  }
};

template <class Dimensions>
Frame frame_of(const Dimensions& image) {
  return {int(image[2]), int(image[1])};
}

// Calls `f(b, lists, rule)` for each member of the batch; lists they share are made once.
template <class F>
ffi::Error for_each(Scene scene, const Frame& frame, Index batch, pgjax::Pool& pool, const F& f) {
  try {
    std::unique_ptr<Lists<T>> lists;
    for (Index b = 0; b < batch; ++b) {
      if (!lists || !scene.is_shared())
        lists = std::make_unique<Lists<T>>(scene.lists(b, frame, pool));
      f(b, *lists, scene.rule(b));
    }
  } catch (const std::exception& error) {
    return ffi::Error(ffi::ErrorCode::kResourceExhausted, error.what());
  }
  return ffi::Error::Success();
}

ffi::Error Composite(ffi::ThreadPool threads, In limits, In shape, In values, In key, Out sums,
                     Out cover, Count pairs) {
  pgjax::Pool pool = pool_of(threads);
  const Frame frame = frame_of(sums->dimensions());
  return for_each({limits, shape, values, key}, frame, sums->dimensions()[0], pool,
                  [&](Index b, const Lists<T>& lists, const Rule<T>& rule) {
                    composite(lists, rule, member(sums, b), member(cover, b), pool);
                    pairs->typed_data()[b] = int(std::min(lists.pairs, Index(INT32_MAX)));
                  });
}

ffi::Error CompositeTangent(ffi::ThreadPool threads, In limits, In shape, In values, In key,
                            In dshape, In dvalues, Out dsums, Out dcover) {
  pgjax::Pool pool = pool_of(threads);
  const Scene scene{limits, shape, values, key};
  const Frame frame = frame_of(dsums->dimensions());
  if (dsums->element_count() + dcover->element_count() == 0) return ffi::Error::Success();
  const Index batch = dsums->dimensions()[0];
  // Tangents of one scene are taken together, if none of them is shared.
  const auto full = [&](In& in) { return in.dimensions()[0] == batch; };
  const Index together = scene.is_shared() && full(dshape) && full(dvalues) ? batch : 1;
  return for_each(scene, frame, batch / together, pool,
                  [&](Index b, const Lists<T>& lists, const Rule<T>& rule) {
                    tangent(lists, rule, together, scene.count(), member(dshape, b),
                            member(dvalues, b), member(dsums, b), member(dcover, b), pool);
                  });
}

ffi::Error CompositeAdjoint(ffi::ThreadPool threads, In limits, In shape, In values, In key,
                            In gsums, In gcover, Out bar_shape, Out bar_values) {
  pgjax::Pool pool = pool_of(threads);
  const Frame frame = frame_of(gsums.dimensions());
  std::fill_n(bar_shape->typed_data(), bar_shape->element_count(), T(0));
  std::fill_n(bar_values->typed_data(), bar_values->element_count(), T(0));
  return for_each({limits, shape, values, key}, frame, bar_shape->dimensions()[0], pool,
                  [&](Index b, const Lists<T>& lists, const Rule<T>& rule) {
                    adjoint(lists, rule, member(gsums, b), member(gcover, b),
                            member(bar_shape, b), member(bar_values, b), pool);
                  });
}

}  // namespace

#define PGJAX_SCENE() \
  ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Arg<In>().Arg<In>().Arg<In>().Arg<In>()

XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_composite, Composite,
                              PGJAX_SCENE().Ret<ffi::Buffer<kType>>().Ret<ffi::Buffer<kType>>()
                                  .Ret<ffi::Buffer<ffi::S32>>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_composite_tangent, CompositeTangent,
                              PGJAX_SCENE().Arg<In>().Arg<In>()
                                  .Ret<ffi::Buffer<kType>>().Ret<ffi::Buffer<kType>>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_composite_adjoint, CompositeAdjoint,
                              PGJAX_SCENE().Arg<In>().Arg<In>()
                                  .Ret<ffi::Buffer<kType>>().Ret<ffi::Buffer<kType>>());
