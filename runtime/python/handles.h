// Objects shared by the parts of the extension module: owners of the memory that the C library works in.
#pragma once

#include <nanobind/nanobind.h>

#include <cstddef>
#include <memory>
#include <stdexcept>
#include <string>

#include "upbeam/upbeam.h"

void bind_live(nanobind::module_ &m);

// Becomes Python's upbeam.runtime.NativeError (a ValueError).
class NativeError : public std::runtime_error {
  public:
    using std::runtime_error::runtime_error;
};

// "what: text (got 3, expected 4, at byte 12)" from a failed call.
std::string describe(upb_status status, const upb_error *error);
void check(upb_status status, const upb_error *error = nullptr);

// Memory aligned to UPB_ALIGN, zeroed.
class AlignedMemory {
  public:
    explicit AlignedMemory(std::size_t bytes);
    void *get() const { return memory_.get(); }
    std::size_t bytes() const { return bytes_; }

  private:
    struct Free {
        void operator()(void *p) const;
    };
    std::size_t bytes_;
    std::unique_ptr<void, Free> memory_;
};

// A loaded model. Immutable: any number of streams may use it at once.
class ModelHandle {
  public:
    explicit ModelHandle(const nanobind::bytes &ubm);
    upb_model *model() const { return model_; }
    upb_model_info info() const;

  private:
    AlignedMemory memory_;
    upb_model *model_ = nullptr;
};
