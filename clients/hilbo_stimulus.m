classdef hilbo_stimulus < handle
% HILBO_STIMULUS  Present the stimuli of a hilbo session from MATLAB (R2020b or newer) or GNU Octave (7 or newer).
%
% hilbo does not guard your actuators, and certifies nothing about them. If your program moves something that people
% touch, an independent hardware stop within reach of the hand must be provided by you.
%
% One file, which needs no toolbox, and in Octave the package instrument-control, for tcpclient, which MATLAB has: copy
% it next to your program.
%
%   stimulus = hilbo_stimulus(link, 'my scene', '1.0');
%   while true
%     order = stimulus.next(0.5);                   % [] where there is no new one within 0.5 s
%     if isempty(order), continue, end
%     if strcmp(order.what, 'present')
%       show(order.show, order.values);             % 'test' with values, a containers.Map; 'reference' without
%       stimulus.presented();                       % or presented(values): the values really presented
%     else
%       blank();
%       stimulus.neutral();
%     end
%   end
%
% There is one thread: this program gives its signs of life, and hears the server, within next, presented, neutral and
% failed. Whatever else it does may take half of the study's silence at most (silence_s, 1 s unless the study says
% otherwise), and then calls next again; a study of slower programs has a longer silence.
%
% A program that moves something says so and gives a function that takes away all force:
%
%   stimulus = hilbo_stimulus(link, 'my arm', '1', 'force', true, 'go_neutral', @limp, 'neutral_within_s', 0.1);
%
% limp is called within those four: as soon as the server orders it, when the connection fails, and at the latest when
% the server has not been heard for silence_s. It is not called while your own code runs: a motor that people touch belongs
% on a controller of its own, with a watchdog. Set stimulus.contact = true while a hand touches it: no order to present
% is handed to you until it is false. docs/guides/stimulus.md of hilbo has the protocol.
%
% An order is a struct: what ('present', 'neutral' or 'stop'), show ('test' or 'reference'), side ('a' or 'b' where two
% tests are compared), values (containers.Map: parameter -> number in the study's unit, or the name of a level), trial, step, number, within_s.

  properties
    contact = false;          % whether a hand touches the moving part
  end
  properties (SetAccess = private)
    parameters = struct('name', {}, 'unit', {}, 'low', {}, 'high', {}, 'tolerance', {}, 'levels', {});
    silence_s = 1;
  end
  properties (Access = private)
    host = '';
    port = 0;
    line = [];                % the connection, while there is one
    key = '';
    hello = {};
    force = false;
    limp = [];
    run = '';
    again = {};               % its own run, whose place it takes at once where the line broke
    order = [];               % the newest
    handed = true;            % whether it was handed out
    done = 'busy';            % what was done about it
    heard = [];               % when the server was heard last (tic)
    said = '';                % why there was no server the last time
  end

  methods
    function s = hilbo_stimulus(link, name, version, varargin)
      % LINK: the one that hilbo session prints for the stimulus, for one program at a time. Options: 'force',
      % 'go_neutral', 'neutral_within_s' (so soon is everything neutral after go_neutral, or after an order; 1 s).
      options = struct('force', false, 'go_neutral', [], 'neutral_within_s', 1);
      for i = 1:2:numel(varargin)
        if ~isfield(options, varargin{i})
          error('hilbo:stimulus', '%s is no option; those are force, go_neutral and neutral_within_s.', varargin{i});
        end
        options.(varargin{i}) = varargin{i + 1};
      end
      if options.force && isempty(options.go_neutral)
        error('hilbo:stimulus', 'A program with force gives go_neutral, a function that takes all force away.');
      end
      parts = regexp(link, '^http://([^/#:]+):(\d+)/?#(.+)$', 'tokens', 'once');
      if isempty(parts)
        error('hilbo:stimulus', 'The link is not one that hilbo session has printed: http://...:.../#...');
      end
      if exist('OCTAVE_VERSION', 'builtin'), pkg('load', 'instrument-control'); end
      s.host = parts{1};
      s.port = str2double(parts{2});
      s.force = options.force;
      s.limp = options.go_neutral;
      words = {'false', 'true'};
      s.hello = {'name', name, 'version', version, 'force', words{1 + s.force}, ...
                 'neutral_within_s', hilbo_stimulus.text_of(options.neutral_within_s)};
      s.order = hilbo_stimulus.silence();
      found = s.post('/api/join', {'token', parts{3}, 'bearer', 'true'}, 10);
      if ~strcmp(hilbo_stimulus.field(found, 'role'), 'stimulus')
        why = hilbo_stimulus.field(found, 'error');
        if isempty(why), why = 'This link is not the one for the stimulus.'; end
        error('hilbo:stimulus', '%s', why);
      end
      s.key = hilbo_stimulus.field(found, 'key');
    end

    function order = next(s, timeout)
      % The newest order that was not handed out yet; [] if there is none within TIMEOUT s. An error when this program
      % is no longer part of the session.
      begun = tic;
      while true
        s.listen(max(0, timeout - toc(begun)));
        waits = s.force && s.contact && strcmp(s.order.what, 'present');
        if ~s.handed && ~waits
          s.handed = true;
          order = s.order;
          return
        end
        if toc(begun) >= timeout
          order = [];
          return
        end
      end
    end

    function taken = presented(s, values)
      % What the last order asked for is shown from now on, with these values (by default those asked for). False if
      % that is not taken: too late, too far off; the trial is void then.
      if nargin < 2, values = s.order.values; end
      fields = {};
      for name = keys(values)
        value = values(name{1});
        if ~ischar(value) && ~isfinite(value)
          error('hilbo:stimulus', '%s is %g, which is no number.', name{1}, value);
        end
        fields = [fields, {['value.' name{1}], hilbo_stimulus.text_of(value)}]; %#ok<AGROW>
      end
      taken = s.say('presented', [{'trial', s.order.trial}, fields]);
    end

    function taken = neutral(s)
      % Nothing is shown, and nothing pushes, from now on.
      taken = s.say('neutral', {});
    end

    function taken = failed(s, why)
      % What the last order asked for cannot be shown; the trial is void.
      taken = s.say('failed', {'why', why(1:min(end, 500))});
    end

    function close(s)
      % Go neutral, and leave: the server sees by the silence that this program is gone.
      s.run = '';
      s.go_neutral();
    end
  end

  methods (Access = private)
    function listen(s, timeout)
      % One question to the server, which may wait with its answer until there is a newer order.
      try
        if isempty(s.run)
          s.begin();
          return
        end
        if toc(s.heard) > s.silence_s
          s.lost(sprintf('the server was not heard for %g s', toc(s.heard)));
          return
        end
        wait = min(timeout, s.silence_s / 3);
        if s.force, wait = min(wait, 0.05); end
        s.report(s.done, {'wait_s', hilbo_stimulus.text_of(wait)});
      catch problem
        if strcmp(problem.identifier, 'hilbo:stimulus'), rethrow(problem); end
        if isempty(s.run) && ~strcmp(s.said, problem.message), s.log(problem.message); end
        s.said = problem.message;
        s.lost(problem.message);
        pause(min(0.2, timeout));
      end
    end

    function begin(s)
      found = s.post('/api/stimulus/hello', [s.hello, s.again], s.silence_s);
      status = hilbo_stimulus.field(found, 'status');
      if any(strcmp(status, {'400', '401', '403'}))
        s.leave(hilbo_stimulus.field(found, 'error'));
      elseif strcmp(status, '200')
        s.parameters = hilbo_stimulus.parameters_of(found);
        s.silence_s = str2double(hilbo_stimulus.field(found, 'silence_s'));
        s.run = hilbo_stimulus.field(found, 'run');
        s.again = {'run', s.run};
        s.order = hilbo_stimulus.silence();
        s.take(found);
      else
        pause(0.2);
      end
    end

    function taken = say(s, state, fields)
      % A report of the program's own; whether it was taken. Where the server was lost there is no server to send it to.
      taken = s.order.number == 0;
      if isempty(s.run) || taken, return, end
      number = s.order.number;
      try
        taken = s.report(state, fields);
      catch problem
        if strcmp(problem.identifier, 'hilbo:stimulus'), rethrow(problem); end
        s.lost(problem.message);
        return
      end
      if taken && s.order.number == number, s.done = state; end
    end

    function taken = report(s, state, fields)
      words = {'false', 'true'};
      if strcmp(state, 'presented') && ~any(strcmp(fields(1:2:end), 'trial'))
        fields = [{'trial', s.order.trial}, fields];
      end
      known = {'run', s.run, 'order', sprintf('%d', s.order.number), 'state', state, 'contact', words{1 + s.contact}};
      found = s.post('/api/stimulus', [known, fields], max(0, s.silence_s - toc(s.heard)));
      status = hilbo_stimulus.field(found, 'status');
      problem = hilbo_stimulus.field(found, 'error');
      taken = strcmp(status, '200');
      if ~taken, s.log(problem); end
      if any(strcmp(status, {'401', '403'}))
        s.leave(problem);
      elseif ~isempty(hilbo_stimulus.field(found, 'order'))
        s.take(found);
      elseif strcmp(status, '409')  % another server, or one that gave this program up
        s.lost(problem);
      end
    end

    function take(s, found)
      % A new order; one that asks for it is neutral at once.
      s.heard = tic;
      number = str2double(hilbo_stimulus.field(found, 'order'));
      if number <= s.order.number, return, end
      s.order = hilbo_stimulus.order_of(found);
      s.handed = false;
      s.done = 'busy';
      if ~strcmp(s.order.what, 'present') && ~isempty(s.limp) && s.go_neutral()
        s.done = 'neutral';
      end
    end

    function lost(s, why)
      % There is no server to be heard: neutral, and said to the program as an order.
      if isempty(s.run), return, end
      s.run = '';
      s.order = hilbo_stimulus.silence();
      s.handed = false;
      s.go_neutral();
      s.log(['neutral: ' why]);
    end

    function leave(s, why)
      s.run = '';
      s.go_neutral();
      error('hilbo:stimulus', '%s', why);
    end

    function well = go_neutral(s)
      well = true;
      if isempty(s.limp), return, end
      try
        feval(s.limp);
      catch problem
        well = false;
        s.log(['go_neutral failed: ' problem.message]);
      end
    end

    function found = post(s, path, fields, seconds)
      % The lines of the answer to a form: a cell of cells of text. An error if there is none within SECONDS.
      begun = tic;
      if isempty(s.line), s.line = tcpclient(s.host, s.port, 'Timeout', seconds); end
      form = hilbo_stimulus.form_of(fields);
      head = {['POST ' path ' HTTP/1.1'], sprintf('Host: %s:%d', s.host, s.port), ...
              'Content-Type: application/x-www-form-urlencoded', sprintf('Content-Length: %d', numel(form))};
      if ~isempty(s.key), head{end + 1} = ['Authorization: Bearer ' s.key]; end
      try
        ends = char([13 10]);
        write(s.line, uint8([strjoin(head, ends), ends, ends, form]));
        [text, last] = s.answer(begun, seconds);
      catch problem
        s.line = [];
        rethrow(problem);
      end
      if last, s.line = []; end
      lines = strsplit(text, char(10), 'CollapseDelimiters', false);
      found = cellfun(@(line) strsplit(line, char(9), 'CollapseDelimiters', false), lines, 'UniformOutput', false);
    end

    function [text, last] = answer(s, begun, seconds)
      % The text of an answer, and whether the connection ends with it. Never waits in a read: that would hide silence.
      bytes = zeros(1, 0, 'uint8');
      head = [];
      while true
        count = s.line.NumBytesAvailable;
        if count > 0, bytes = [bytes, reshape(uint8(read(s.line, count)), 1, [])]; end %#ok<AGROW>
        if isempty(head)
          stop = strfind(char(bytes), char([13 10 13 10]));
          if ~isempty(stop), head = lower(char(bytes(1:stop(1) + 1))); end
        end
        if ~isempty(head)
          length = regexp(head, '\ncontent-length: *(\d+)', 'tokens', 'once');
          whole = stop(1) + 3 + str2double(length{1});
          if numel(bytes) >= whole, break, end
        end
        if toc(begun) > seconds, error('hilbo:silent', 'the server does not answer'); end
        if count == 0, pause(0.001); end
      end
      text = native2unicode(bytes(stop(1) + 4:whole), 'UTF-8');
      last = ~isempty(strfind(head, [char(10) 'connection: close'])); %#ok<STREMP>
    end

    function log(~, words)
      fprintf(2, '%s hilbo_stimulus: %s\n', datestr(now, 'yyyy-mm-dd HH:MM:SS.FFF'), words); %#ok<TNOW1,DATST>
    end
  end

  methods (Static, Access = private)
    function form = form_of(fields)
      % Names and values, percent-encoded.
      form = '';
      for i = 1:numel(fields)
        for byte = double(unicode2native(fields{i}, 'UTF-8'))
          if any(byte == ['a':'z' 'A':'Z' '0':'9' '-_.~'])
            form(end + 1) = char(byte); %#ok<AGROW>
          else
            form = [form sprintf('%%%02X', byte)]; %#ok<AGROW>
          end
        end
        marks = '&=';
        form(end + 1) = marks(1 + mod(i, 2)); %#ok<AGROW>
      end
      form = form(1:end - 1);
    end

    function order = silence()
      % What holds before a server has spoken, and after one is silent.
      order = struct('number', 0, 'what', 'neutral', 'show', '', 'side', '', 'trial', '', 'step', 0, ...
                     'values', containers.Map('KeyType', 'char', 'ValueType', 'any'), 'within_s', 0);
    end

    function order = order_of(found)
      order = hilbo_stimulus.silence();
      order.number = str2double(hilbo_stimulus.field(found, 'order'));
      order.what = hilbo_stimulus.field(found, 'do');
      order.show = hilbo_stimulus.field(found, 'show');
      order.side = hilbo_stimulus.field(found, 'side');
      order.trial = hilbo_stimulus.field(found, 'trial');
      order.step = str2double(hilbo_stimulus.field(found, 'step'));
      order.within_s = str2double(hilbo_stimulus.field(found, 'within_s'));
      for i = 1:numel(found)
        line = found{i};
        if strcmp(line{1}, 'value')
          number = str2double(line{3});
          if isnan(number), number = line{3}; end  % a level
          order.values(line{2}) = number;
        end
      end
    end

    function parameters = parameters_of(found)
      parameters = struct('name', {}, 'unit', {}, 'low', {}, 'high', {}, 'tolerance', {}, 'levels', {});
      for i = 1:numel(found)
        line = found{i};
        if strcmp(line{1}, 'parameter')
          parameters(end + 1) = struct('name', line{2}, 'unit', line{6}, 'low', str2double(line{3}), ...
                                       'high', str2double(line{4}), 'tolerance', str2double(line{5}), ...
                                       'levels', {{}}); %#ok<AGROW>
        elseif strcmp(line{1}, 'levels')
          parameters(end + 1) = struct('name', line{2}, 'unit', '', 'low', 0, 'high', 0, 'tolerance', 0, ...
                                       'levels', {line(3:end)}); %#ok<AGROW>
        end
      end
    end

    function text = field(found, name)
      % The second field of the line of that name, '' if there is none.
      text = '';
      for i = 1:numel(found)
        if numel(found{i}) > 1 && strcmp(found{i}{1}, name)
          text = found{i}{2};
          return
        end
      end
    end

    function text = text_of(value)
      text = value;
      if ~ischar(value), text = sprintf('%.17g', value); end
    end
  end
end
